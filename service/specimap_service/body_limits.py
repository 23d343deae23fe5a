"""Limits on request bodies: none is read before the key is known, and none beyond the size that its kind may have.

Files and labels are written to disk as they arrive, within limits of their own. All other bodies are JSON documents,
which are read into memory.
"""

from __future__ import annotations

import re
from typing import TypeVar

from fastapi.exceptions import RequestValidationError
from fastapi.requests import Request
from pydantic import BaseModel, ValidationError
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specimap_core.errors import SpecimapError
from specimap_infra.logs import logger
from specimap_service.auth.credentials import check_page
from specimap_service.auth.dependencies import PRINCIPAL, authenticated
from specimap_service.errors import PayloadTooLargeError, RequestInvalidError
from specimap_service.fair_turns import FairTurns
from specimap_service.http_status import status_of
from specimap_service.problems import problem_response

MIB = 1024 * 1024
LARGEST_JSON = 64 * 1024
"""Settings of a job, an acquisition, a key: a hundred times what they need."""
LARGEST_SELECTION = 4 * MIB
"""A page of points by number or by pixel: 100,000 of them, with spare bytes for blanks."""
LARGEST_SIGN_IN = 4 * 1024
"""The one body that is read without a key: it holds the key."""
SIGN_IN = ("POST", "/v1/session")
MOST_FIELDS = 1000
"""More than the names in a selection: each unknown one would be listed in the answer, which takes time."""
MOST_PARTS = 4000
"""Colons and commas in another document: more than the longest notes hold."""
SELECTIONS = (("POST", re.compile(r"/v1/clouds/[^/]+/spectra")),)
FILES = (
    ("POST", re.compile(r"/v1/acquisitions/[^/]+/files")),
    ("PATCH", re.compile(r"/v1/uploads/[^/]+")),
    ("PUT", re.compile(r"/v1/clouds/[^/]+/labels/[^/]+")),
    ("POST", re.compile(r"/v1/dicomweb/studies")),
)
"""Requests whose routes write the body to disk piece by piece."""
WITHOUT_BODY = ("GET", "HEAD", "OPTIONS")
Model = TypeVar("Model", bound=BaseModel)


def most_bytes(method: str, path: str) -> int | None:
    """Return the bytes that a request's body may have; None where its route sets limits of its own."""
    if any(method == known and pattern.fullmatch(path) for known, pattern in FILES):
        return None
    if (method, path) == SIGN_IN:
        return LARGEST_SIGN_IN
    selection = any(method == known and pattern.fullmatch(path) for known, pattern in SELECTIONS)
    return LARGEST_SELECTION if selection else LARGEST_JSON


class BodyLimits:
    """Middleware that checks the key before a byte of the body is read, and refuses bodies beyond their limit: by their
    Content-Length, or else as they arrive. Where a person signs in, it checks which page asks."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or answer 401, 403, 413 or 429."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        limit = most_bytes(scope["method"], scope["path"])
        try:
            if (scope["method"], scope["path"]) == SIGN_IN:
                check_page(request)
            elif scope["method"] not in WITHOUT_BODY:
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
        received = parts = 0
        refusal: SpecimapError | None = None

        async def counted() -> Message:
            nonlocal received, parts, refusal
            message = await receive()
            body = message.get("body", b"")
            received += len(body)
            parts += body.count(b":") + body.count(b",")
            if received > limit:
                refusal = _too_large(limit)
            elif limit in (LARGEST_JSON, LARGEST_SIGN_IN) and parts > MOST_PARTS:
                refusal = _too_many()
            if refusal is not None:
                raise refusal
            return message

        async def own(message: Message) -> None:
            # The code that reads the body answers any error with a 400 of its own; the refusal is sent below.
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


async def parsed(request: Request, model: type[Model], turns: FairTurns, key: str) -> Model:
    """Parse a large JSON body in a thread, so that other requests are answered meanwhile.

    ``turns`` bounds how many are parsed at a time, and shares them between keys.

    Raises:
        RequestValidationError, RequestInvalidError: the body is not such a document.
        TooManyAtOnceError, OverloadedError: too many wait to be parsed.
    """
    body = await request.body()
    if len(body) <= LARGEST_JSON:  # a millisecond: less than a thread for it would cost all together
        return _parse(body, model)
    return await turns.run(key, _parse, body, model)


def _parse(body: bytes, model: type[Model]) -> Model:
    if body.count(b":") > MOST_FIELDS:
        raise _too_many()
    try:
        return model.model_validate_json(body)
    except ValidationError as error:
        found = error.errors(include_url=False, include_context=False, include_input=False)
        raise RequestValidationError([{**item, "loc": ("body", *item["loc"])} for item in found]) from error
