"""Limits on the bodies that are read into memory: JSON documents. Files have limits of their own, and go to disk."""

from __future__ import annotations

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specimap.infra.errors import PayloadTooLargeError
from specimap.service.problems import problem_response

LARGEST_JSON = 16 * 1024 * 1024
"""A million indices and more."""


class JsonLimit:
    """Refuses JSON bodies beyond 16 MiB, by what they say of themselves or else as they come."""

    def __init__(self, app: ASGIApp, limit: int = LARGEST_JSON) -> None:
        self._app = app
        self._limit = limit

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 413."""
        headers = dict(scope.get("headers", ()))
        kind = headers.get(b"content-type", b"application/json").partition(b";")[0].strip().lower()
        if scope["type"] != "http" or not (kind.endswith(b"json") or kind.startswith(b"text/")):
            await self._app(scope, receive, send)
            return
        size = headers.get(b"content-length", b"0")
        if size.isdigit() and int(size) > self._limit:
            await problem_response(self._refusal())(scope, receive, send)
            return
        came = 0

        async def counted() -> Message:
            nonlocal came
            message = await receive()
            came += len(message.get("body", b""))
            if came > self._limit:
                raise self._refusal()
            return message

        async def own(message: Message) -> None:
            # What reads the body answers any error there with a 400 of its own: this one is told below.
            if came <= self._limit:
                await send(message)

        await self._app(scope, counted, own)
        if came > self._limit:
            await problem_response(self._refusal())(scope, receive, send)

    def _refusal(self) -> PayloadTooLargeError:
        return PayloadTooLargeError(
            f"The body is larger than {self._limit} bytes.",
            advice="Ask in several requests.",
            limit_bytes=self._limit,
        )
