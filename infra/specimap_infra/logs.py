"""Structured logs: one JSON object in each line, with the correlation id and the pseudonymous ids bound to it."""

from __future__ import annotations

import logging
import sys

import structlog
from structlog.tracebacks import ExceptionDictTransformer

from specimap_core.json_text import json_log_line
from specimap_infra.settings import ServiceSettings

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
    for name in ("uvicorn", "uvicorn.error", "uvicorn.access", "dbos", "alembic", "tuspyserver"):
        logger = logging.getLogger(name)
        logger.handlers[:] = []
        logger.propagate = True
    # The service writes its own access log; the libraries' routine lines are of no use.
    for name in ("uvicorn.access", "dbos", "alembic", "tuspyserver", "httpx", "httpcore"):
        logging.getLogger(name).setLevel(max(level, logging.WARNING))


def logger() -> structlog.stdlib.BoundLogger:
    """Return a logger; bind ids to it, never uploaded names."""
    return structlog.stdlib.get_logger("specimap")
