"""HEAD wherever there is GET (RFC 9110): the same answer without its content."""

from __future__ import annotations

import re

from fastapi import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

ONLY_HEAD = "specimap.head"
OWN = re.compile(r"/v1/uploads/[^/]*")
"""Addresses whose HEAD is something of its own: tus asks for the offset with it."""


class HeadRequests:
    """Middleware that has HEAD answered as GET, and ends the answer after its headers."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http" or scope["method"] != "HEAD" or OWN.fullmatch(scope["path"]):
            await self._app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            if message["type"] == "http.response.start":
                await send(message)
                # What makes the content sees from now on a client that is gone, and stops.
                await send({"type": "http.response.body", "body": b"", "more_body": False})

        # A copy, since the server omits the content by its own.
        inner = {**scope, "method": "GET", ONLY_HEAD: True}
        try:
            await self._app(inner, receive, send_head)
        finally:
            if "route" in inner:
                scope["route"] = inner["route"]


def only_head(request: Request) -> bool:
    """Return whether the content of the answer would be thrown away."""
    return ONLY_HEAD in request.scope
