"""Structured logs: one JSON object in each line, with the correlation id and the pseudonymous ids bound to it."""

from __future__ import annotations

import logging
import re
import sys
import threading
import time

import structlog
from structlog.tracebacks import ExceptionDictTransformer

from specimap_core.json_text import json_log_line
from specimap_infra.settings import ServiceSettings

LONGEST_LINE = 400
MOST_KINDS = 1000
SHARED: tuple[structlog.typing.Processor, ...] = (
    structlog.contextvars.merge_contextvars,
    structlog.processors.add_log_level,
    structlog.processors.TimeStamper(fmt="iso", utc=True),
)


def set_up_logs(settings: ServiceSettings) -> None:
    """Send the program's and its libraries' logs to standard error in the chosen format."""
    level = getattr(logging, settings.log_level.upper())
    if settings.log_format == "json":
        tail: list[structlog.typing.Processor] = [
            # Without local variables: keys and uploaded names are among them.
            structlog.processors.ExceptionRenderer(ExceptionDictTransformer(show_locals=False)),
            structlog.processors.JSONRenderer(serializer=json_log_line),
        ]
    else:
        plain = structlog.dev.plain_traceback
        tail = [structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty(), exception_formatter=plain)]
    structlog.configure(
        processors=[*SHARED, structlog.stdlib.ProcessorFormatter.wrap_for_formatter],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.stdlib.LoggerFactory(),
        cache_logger_on_first_use=False,
    )
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        structlog.stdlib.ProcessorFormatter(
            foreign_pre_chain=SHARED,
            processors=[structlog.stdlib.ProcessorFormatter.remove_processors_meta, *tail],
        )
    )
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level)
    for name in ("dbos", "sqlalchemy.pool"):
        logging.getLogger(name).filters[:] = [OneLine()]
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "dbos", "alembic", "tuspyserver"):
        logger = logging.getLogger(name)
        logger.handlers[:] = []
        logger.propagate = True
    # The service writes its own access log; the libraries' routine lines are of no use.
    for name in ("uvicorn.access", "dbos", "alembic", "tuspyserver", "httpx", "httpcore"):
        logging.getLogger(name).setLevel(max(level, logging.WARNING))


class OneLine(logging.Filter):
    """Cut what a library logs of a failure to its first line, and let the same line pass only now and then.

    While the database is away the job engine and the pool of connections log each of their tries, with statements and
    tracebacks: some megabytes an hour that say one thing.
    """

    EVERY_SECONDS = 30.0

    def __init__(self) -> None:
        super().__init__()
        self._passed: dict[str, float] = {}
        self._lock = threading.Lock()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is logged; it is cut."""
        if record.levelno < logging.WARNING:
            return True
        if record.exc_info and record.exc_info[1] is not None:
            error = record.exc_info[1]
            record.msg, record.args = f"{record.getMessage()} {type(error).__name__}: {error}", ()
        record.exc_info = record.exc_text = record.stack_info = None
        record.msg, record.args = record.getMessage().strip().split("\n", 1)[0][:LONGEST_LINE], ()
        # Numbers differ from try to try: of the time to the next one, of the connection.
        kind, now = re.sub(r"[0-9.]+", "", record.msg), time.monotonic()
        with self._lock:
            if now - self._passed.get(kind, -self.EVERY_SECONDS) < self.EVERY_SECONDS:
                return False
            if len(self._passed) > MOST_KINDS:
                self._passed.clear()
            self._passed[kind] = now
        return True


def logger() -> structlog.stdlib.BoundLogger:
    """Return a logger; bind ids to it, never uploaded names."""
    return structlog.stdlib.get_logger("specimap")
