"""What happens to a job, as it happens: server-sent events, resumed by ``Last-Event-ID``."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator

from specimap_client import _retries
from specimap_client._errors import (
    ConnectionFailed,
    RateLimited,
    ServerError,
    SpecimapClientError,
    Timeout,
    UnexpectedAnswer,
)
from specimap_client._http import Session, path
from specimap_client._models import FINAL_STATES, Event

SILENCE_S = 40.0
"""A sign of life comes every 15 s: a stream that is silent for longer is broken, or a proxy holds it back."""
MEDIA_TYPE = "text/event-stream"


class HeldBackError(SpecimapClientError):
    """The stream gives nothing: something in between holds it back."""


def job_events(session: Session, job: str, after: int = 0, deadline: float | None = None) -> Iterator[Event]:
    """Events after ``after`` until the job ends, over as many connections as it takes.

    Raises:
        Timeout: ``deadline``, of the monotonic clock, has passed.
        ConnectionFailed, ServerError: no connection, or nothing new, in as many attempts as ``Retries`` says.
    """
    failures = 0
    while True:
        headers = {"Accept": MEDIA_TYPE, "Cache-Control": "no-store"}
        if after:
            headers["Last-Event-ID"] = str(after)
        wait: float | None = None
        try:
            with session.stream(path("jobs", job, "events"), headers=headers, timeout=_left(deadline)) as answer:
                if answer.status_code == 204:
                    return  # it has ended, and all is known
                if not answer.headers.get("Content-Type", "").startswith(MEDIA_TYPE):
                    raise UnexpectedAnswer("The service answered with something else than events.")
                for event in parse(answer.iter_raw()):
                    after, failures = event.seq, 0
                    yield event
                    if event.type == "state" and event.data.get("state") in FINAL_STATES:
                        return
                    _left(deadline)
            # The server ends a stream when it restarts, too.
            problem: SpecimapClientError = ConnectionFailed("The stream of events ended before the job did.")
        except (ConnectionFailed, ServerError, RateLimited) as error:
            problem = error
            wait = error.retry_after if isinstance(error, RateLimited) else None
        except Timeout as error:
            if deadline is not None and time.monotonic() >= deadline:
                raise Timeout(f"{job} has not ended in the time given.") from error
            problem = HeldBackError("The stream of events is silent.")
        failures += 1
        if failures >= session.retries.attempts or (isinstance(problem, HeldBackError) and failures >= 2):
            raise problem
        _retries.sleep(session.retries.delay(failures - 1, wait))


def parse(pieces: Iterable[bytes]) -> Iterator[Event]:
    """The events in a stream of bytes. Lines end with LF or CRLF; comments and events without id are passed over."""
    fields: dict[str, str] = {}
    for line in _lines(pieces):
        if not line:
            if fields.get("id", "").isdigit() and "data" in fields:
                yield _event(fields)
            fields = {}
        elif not line.startswith(":"):
            name, _, value = line.partition(":")
            value = value.removeprefix(" ")
            fields[name] = f"{fields[name]}\n{value}" if name == "data" and name in fields else value


def _lines(pieces: Iterable[bytes]) -> Iterator[str]:
    rest = b""
    for piece in pieces:
        # Not splitlines: a log message may hold other line separators, which end no line here.
        *lines, rest = (rest + piece).split(b"\n")
        for line in lines:
            yield line.removesuffix(b"\r").decode("utf-8", "replace")


def _event(fields: dict[str, str]) -> Event:
    try:
        data = json.loads(fields["data"])
    except ValueError as error:
        raise UnexpectedAnswer("An event's data are no JSON.") from error
    return Event.of({"seq": int(fields["id"]), "type": fields.get("event", "message"), "data": data})


def _left(deadline: float | None) -> float:
    """Seconds that a stream may be silent for. Raises Timeout."""
    if deadline is None:
        return SILENCE_S
    left = deadline - time.monotonic()
    if left <= 0:
        raise Timeout("The time given is over.")
    return min(left, SILENCE_S)
