"""HTTP connections with bounds on what a client may send before its key is checked: the head of a request, and bytes
after its body."""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

LARGEST_HEAD = 64 * 1024
"""Bytes of a request's line and headers; one read of the socket may go beyond."""
HEAD_SECONDS = 30.0
"""How long a request's head may take to arrive."""


class Connection(HttpToolsProtocol):
    """One connection. uvicorn's own collects a head without limit, and copies it again with each piece that arrives."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._in_head = True
        self._bytes = 0
        self._progressed = False
        self._deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request."""
        super().connection_made(transport)
        self._wait_for_head()

    def connection_lost(self, exc: Exception | None) -> None:
        """Stop waiting."""
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse a piece; close the connection if too many bytes complete neither a head nor a body."""
        if self._in_head and self._deadline is None:
            self._wait_for_head()
        self._progressed = False
        super().data_received(data)
        if self._progressed or self.transport.is_closing():
            return
        self._bytes += len(data)
        if self._bytes > LARGEST_HEAD:
            self._stop_waiting()
            self.send_400_response("The request's headers are too large.")

    def on_header(self, name: bytes, value: bytes) -> None:
        """Keep a header; ignore one after the body."""
        if self._in_head:
            super().on_header(name, value)

    def on_message_begin(self) -> None:
        """Start a request."""
        self._progress(in_head=True)
        super().on_message_begin()

    def on_headers_complete(self) -> None:
        """Pass the request on."""
        self._progress(in_head=False)
        self._stop_waiting()
        super().on_headers_complete()

    def on_body(self, body: bytes) -> None:
        """Pass a piece of the body on."""
        self._progress(in_head=False)
        super().on_body(body)

    def on_message_complete(self) -> None:
        """Get ready for the next request."""
        self._progress(in_head=True)
        super().on_message_complete()

    def _progress(self, *, in_head: bool) -> None:
        self._in_head, self._bytes, self._progressed = in_head, 0, True

    def _wait_for_head(self) -> None:
        self._deadline = self.loop.call_later(HEAD_SECONDS, self._on_timeout)

    def _on_timeout(self) -> None:
        if self.cycle is not None and not self.cycle.response_complete:
            # An answer is under way: the next request may wait for it.
            self._wait_for_head()
        else:
            self.timeout_keep_alive_handler()

    def _stop_waiting(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None
