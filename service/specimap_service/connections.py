"""HTTP connections with bounds on what a client may send before its key is checked, and on how long it may keep the
service waiting: for a head, for a body, for the reading of an answer."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

from fastapi.responses import Response
from uvicorn.protocols.http.httptools_impl import STATUS_LINE, HttpToolsProtocol

from specimap_infra.settings import ServiceSettings
from specimap_service.admission import Admission, fit_open_files
from specimap_service.errors import RequestTimeoutError, TooManyConnectionsError
from specimap_service.problems import problem_response
from specimap_service.security_headers import add_security_headers

LARGEST_HEAD = 64 * 1024
"""Bytes of a request's line and headers; one read of the socket may go beyond."""
LEAST_BYTES = 1024
"""Bytes of a body, or of an answer, that count as progress."""
RETRY_SECONDS = 5
REFUSED_SECONDS = 2.0
"""How long a refused connection may take to read why."""


class Owed(Enum):
    """What the service waits for."""

    NOTHING = "nothing"
    REQUEST = "request"
    """Nothing has come since the answer before."""
    HEAD = "head"
    BODY = "body"
    READING = "reading"
    """An answer is sent but not read."""
    END = "end"
    """The connection is closed, but has bytes that are not read."""


@dataclass(frozen=True)
class Patience:
    """Seconds that a connection may keep the service waiting."""

    head: float
    keep_alive: float
    silence: float

    def seconds(self, owed: Owed) -> float:
        """Return how long the service waits."""
        return {Owed.REQUEST: self.keep_alive, Owed.HEAD: self.head}.get(owed, self.silence)

    @property
    def step(self) -> float:
        """How often a connection is looked at."""
        return min(1.0, min(self.head, self.keep_alive, self.silence) / 4)


class Connection(HttpToolsProtocol):
    """One connection. uvicorn's own collects a head without limit, copies it again with each piece that arrives, and
    waits without end for everything but the next request."""

    patience: ClassVar[Patience]
    admission: ClassVar[Admission]

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._in_head, self._in_body = True, False
        self._head_begun = True
        """The first request is due at once; a later one, when its first byte has come."""
        self._bytes = 0
        self._progressed = False
        self._refused = False
        self._timer: asyncio.TimerHandle | None = None
        self._steps = 0
        self._body_bytes = 0
        self._mark = (Owed.NOTHING, -1)
        self._measure, self._since = 0, 0.0

    # ---- the connection ---------------------------------------------------------------------------------

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request; refuse it now where there are too many connections."""
        super().connection_made(transport)
        address = self.client[0] if self.client else ""
        if not self.admission.admit(self, address):
            self._refuse()
            return
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        """Free the place."""
        if self._timer is not None:
            self._timer.cancel()
        self.admission.leave(self)
        super().connection_lost(exc)

    def give_way(self) -> None:
        """Close a connection without a request under way."""
        self.transport.close()

    def _refuse(self) -> None:
        self._refused = True
        error = TooManyConnectionsError(
            "There are too many connections.", advice=f"Try again in {RETRY_SECONDS} s.", retry_after_s=RETRY_SECONDS
        )
        self._write(problem_response(error, None, **{"Retry-After": str(RETRY_SECONDS)}))
        if not self.admission.may_be_told(self):
            self.transport.close()
            return
        # A connection closed with unread bytes is reset, and the client may not see the answer: it ends it itself.
        self.transport.write_eof()
        self._timer = self.loop.call_later(REFUSED_SECONDS, self.transport.abort)

    # ---- a request --------------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        """Parse a piece; close the connection if too many bytes complete neither a head nor a body."""
        if self._refused:
            return
        if self._in_head:
            self._head_begun = True
        self._progressed = False
        super().data_received(data)
        if self._progressed or self.transport.is_closing():
            return
        self._bytes += len(data)
        if self._bytes > LARGEST_HEAD:
            self.send_400_response("The request's headers are too large.")

    def on_header(self, name: bytes, value: bytes) -> None:
        """Keep a header; ignore one after the body."""
        if self._in_head:
            super().on_header(name, value)

    def on_message_begin(self) -> None:
        """Start a request."""
        self._progress(in_head=True)
        self._head_begun = True
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Pass the request on."""
        self._progress(in_head=False)
        self._head_begun, self._in_body = False, True
        self.admission.set_waiting(self, False)
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Pass a piece of the body on."""
        self._progress(in_head=False)
        self._body_bytes += len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Get ready for the next request."""
        self._progress(in_head=True)
        self._in_body = False
        super().on_message_complete()
        self.admission.set_waiting(self, not self._busy)

    def on_response_complete(self) -> None:
        """Wait for the next request, unless it has come already."""
        self._steps += 1
        super().on_response_complete()
        # Also where the rest of a body is still to come: nobody waits for it any more.
        self.admission.set_waiting(self, not self._busy)

    def resume_writing(self) -> None:
        """Go on with an answer of which enough has been read."""
        self._steps += 1
        super().resume_writing()

    @property
    def _busy(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _progress(self, *, in_head: bool) -> None:
        self._steps += self._in_head != in_head
        self._in_head, self._bytes, self._progressed = in_head, 0, True

    # ---- patience ---------------------------------------------------------------------------------------

    def _owed(self) -> Owed:
        if self.transport.is_closing():
            return Owed.END
        if self.flow.write_paused or (not self._busy and self.transport.get_write_buffer_size()):
            return Owed.READING
        if self._in_body:
            # The app does not want more yet, or the client waits to be asked for the body.
            not_wanted = self._busy and (self.flow.read_paused or self.cycle.waiting_for_100_continue)
            return Owed.NOTHING if not_wanted else Owed.BODY
        if self._busy:
            return Owed.NOTHING
        return Owed.HEAD if self._head_begun else Owed.REQUEST

    def _look(self) -> None:
        """See what the service waits for, and end the connection if it has waited long enough."""
        self._timer = self.loop.call_later(self.patience.step, self._look)
        owed, now = self._owed(), self.loop.time()
        measure = self._body_bytes if owed is Owed.BODY else -self.transport.get_write_buffer_size()
        progressed = owed is not Owed.HEAD and measure - self._measure >= LEAST_BYTES
        if self._mark != (owed, self._steps) or progressed:
            self._mark, self._measure, self._since = (owed, self._steps), measure, now
        elif owed is not Owed.NOTHING and now - self._since >= self.patience.seconds(owed):
            self._give_up(owed)

    def _give_up(self, owed: Owed) -> None:
        if owed in (Owed.READING, Owed.END) or (self._busy and self.cycle.response_started):
            self.transport.abort()
            return
        if self._busy:
            # The app sees a client that is gone; what it still answers is not sent.
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self._busy or (owed is Owed.HEAD and self._bytes):
            error = RequestTimeoutError(
                "The rest of the request did not arrive in time.",
                advice="Send it again; files over slow networks in smaller pieces, to /v1/uploads.",
                seconds=self.patience.seconds(owed),
            )
            self._write(problem_response(error))
        self.transport.close()

    def _write(self, answer: Response) -> None:
        """Write an answer that no app made, the last one of the connection."""
        add_security_headers(answer.headers, "")
        fields = [*self.server_state.default_headers, *answer.raw_headers, (b"connection", b"close")]
        head = b"".join(name + b": " + value + b"\r\n" for name, value in fields)
        self.transport.write(STATUS_LINE[answer.status_code] + head + b"\r\n" + bytes(answer.body))


def connections_within(settings: ServiceSettings) -> type[Connection]:
    """Make the class of a server's connections, with the limits that the settings name."""
    most = fit_open_files(settings.max_connections)
    per_address = min(settings.max_connections_per_address, most)

    class Limited(Connection):
        patience = Patience(settings.head_seconds, settings.keep_alive_seconds, settings.silence_seconds)
        admission = Admission(most, per_address)

    return Limited
