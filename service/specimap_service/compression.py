"""JSON answers compressed on their way, for clients that accept it."""

from __future__ import annotations

import re

from starlette.datastructures import Headers
from starlette.middleware.gzip import GZipResponder, IdentityResponder
from starlette.types import ASGIApp, Message, Receive, Scope, Send

SMALLEST = 1000
"""Bytes below which compression gains nothing."""
LEVEL = 4
"""Half the time of the usual one for hardly more bytes."""
_GZIP = re.compile(r"(?:^|,)\s*(?:gzip|\*)\s*(?:$|,|;(?!\s*q=0(?:\.0*)?\s*(?:$|,)))", re.IGNORECASE)


def takes_gzip(headers: Headers) -> bool:
    """Return whether the client that sent the headers accepts gzip."""
    return _GZIP.search(headers.get("accept-encoding", "")) is not None


class _OnlyJson(IdentityResponder):
    """A responder that lets everything pass but JSON without a tag.

    A tag names bytes: the same one may not stand for compressed and for plain ones. What has a tag is stored, and
    fetched again only when it has changed.
    """

    passes = False

    async def send_with_compression(self, message: Message) -> None:
        """Send a part of the answer."""
        if message["type"] == "http.response.start":
            headers = Headers(raw=message.get("headers", []))
            media = headers.get("content-type", "").partition(";")[0]
            self.passes = media not in ("application/json", "application/problem+json") or "etag" in headers
        if self.passes:
            await self.send(message)
        else:
            await super().send_with_compression(message)


class _Gzip(_OnlyJson, GZipResponder):
    """Compresses."""


class _Plain(_OnlyJson):
    """Compresses nothing, but says that it might have."""


class Compression:
    """Middleware that compresses JSON answers with gzip."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
        elif takes_gzip(Headers(scope=scope)):
            await _Gzip(self._app, SMALLEST, LEVEL)(scope, receive, send)
        else:
            await _Plain(self._app, SMALLEST)(scope, receive, send)
