"""What of a request's body is read, and when: nothing before the key is known, and never more than its kind may have.

Files and labels are written to the disk as they come, within limits of their own. All other bodies are JSON documents,
which are read into memory.
"""

from __future__ import annotations

import re
from functools import partial
from typing import TypeVar

from anyio import CapacityLimiter, to_thread
from fastapi.exceptions import RequestValidationError
from fastapi.requests import Request
from pydantic import BaseModel, ValidationError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specimap_core.errors import SpecimapError
from specimap_infra.logs import logger
from specimap_service.auth.keys import PRINCIPAL, authenticated
from specimap_service.errors import PayloadTooLargeError, RequestInvalidError
from specimap_service.http_status import status_of
from specimap_service.problems import problem_response

MIB = 1024 * 1024
LARGEST_JSON = 64 * 1024
"""Settings of a job, an acquisition, a key: a hundred times what they take."""
LARGEST_SELECTION = 4 * MIB
"""A page of points by number or by pixel: 100,000 with room for blanks."""
MOST_FIELDS = 1000
"""Names in a selection, and more: each that does not exist would be told of, which takes time."""
MOST_PARTS = 4000
"""Colons and commas in another document: those of the longest notes, and more."""
SELECTIONS = (("POST", re.compile(r"/v1/clouds/[^/]+/spectra")),)
FILES = (
    ("POST", re.compile(r"/v1/acquisitions/[^/]+/files")),
    ("PATCH", re.compile(r"/v1/uploads/[^/]+")),
    ("PUT", re.compile(r"/v1/clouds/[^/]+/labels/[^/]+")),
)
"""Requests whose bodies are taken to the disk by their own routes, which read them piece by piece."""
WITHOUT_BODY = ("GET", "HEAD", "OPTIONS")
Model = TypeVar("Model", bound=BaseModel)


def most_bytes(method: str, path: str) -> int | None:
    """Bytes that a request's body may have; None where its route sets limits of its own."""
    if any(method == known and pattern.fullmatch(path) for known, pattern in FILES):
        return None
    selection = any(method == known and pattern.fullmatch(path) for known, pattern in SELECTIONS)
    return LARGEST_SELECTION if selection else LARGEST_JSON


class Gate:
    """Middleware: asks for the key before a byte of the body is read, and refuses bodies beyond their limit by what
    they say of themselves, or else as they come."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 401, 413 or 429."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        limit = most_bytes(scope["method"], scope["path"])
        try:
            if scope["method"] not in WITHOUT_BODY:
                scope[PRINCIPAL] = await authenticated(request)
            size = request.headers.get("content-length", "0")
            if limit is not None and size.isdecimal() and int(size) > limit:
                raise _too_large(limit)
        except SpecimapError as error:
            if status_of(error) >= 500:
                logger().error("request failed", code=error.code, exc_info=error)
            await problem_response(error)(scope, receive, send)
            return
        if limit is None:
            await self._app(scope, receive, send)
        else:
            await self._counted(limit, scope, receive, send)

    async def _counted(self, limit: int, scope: Scope, receive: Receive, send: Send) -> None:
        came = parts = 0
        refusal: SpecimapError | None = None

        async def counted() -> Message:
            nonlocal came, parts, refusal
            message = await receive()
            body = message.get("body", b"")
            came += len(body)
            parts += body.count(b":") + body.count(b",")
            if came > limit:
                refusal = _too_large(limit)
            elif limit == LARGEST_JSON and parts > MOST_PARTS:
                refusal = _too_many()
            if refusal is not None:
                raise refusal
            return message

        async def own(message: Message) -> None:
            # What reads the body answers any error there with a 400 of its own: this one is told below.
            if refusal is None:
                await send(message)

        try:
            await self._app(scope, counted, own)
        except SpecimapError:
            if refusal is None:
                raise
        if refusal is not None:
            await problem_response(refusal)(scope, receive, send)


def _too_large(limit: int) -> PayloadTooLargeError:
    return PayloadTooLargeError(
        f"The body is larger than {limit} bytes.", advice="Ask in several requests.", limit_bytes=limit
    )


def _too_many() -> RequestInvalidError:
    return RequestInvalidError("body: too many fields.", advice="Correct the request; /docs shows it.")


async def parsed(request: Request, model: type[Model]) -> Model:
    """A large JSON body, read by a thread, one at a time: other requests are answered meanwhile.

    Raises:
        RequestValidationError, RequestInvalidError: it is no such document.
    """
    limiter: CapacityLimiter = request.app.state.parsing
    body = await request.body()
    return await to_thread.run_sync(partial(_parse, body, model), limiter=limiter)


def _parse(body: bytes, model: type[Model]) -> Model:
    if body.count(b":") > MOST_FIELDS:
        raise _too_many()
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        raise RequestValidationError([{**item, "loc": ("body", *item["loc"])} for item in found]) from error
