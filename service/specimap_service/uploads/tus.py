"""tus 1.0 around ``tuspyserver``: the parts of the protocol that the library lacks or does differently.

Added are offsets that survive a killed process, checksums, locks that a dead connection does not keep, errors that
reach the client (the library answers a full disk with success), a Location that does not trust
``X-Forwarded-Host``, and headers of HEAD. Every request to an upload has one :class:`Exchange`, which these parts
share.
"""

from __future__ import annotations

import asyncio
import base64
import binascii
import hashlib
import tempfile
from contextvars import ContextVar
from email.utils import format_datetime
from pathlib import Path

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from specimap_core.atomic import disk_errors
from specimap_infra.tables import Upload
from specimap_service.auth.keys import Principal
from specimap_service.errors import ChecksumInvalidError, ChecksumMismatchError, UploadConflictError

PREFIX = "/v1/uploads"
VERSION = "1.0.0"
EXTENSIONS = "creation,checksum,expiration,termination"
ALGORITHMS = ("sha1", "sha256", "md5")
BATCH = 1024 * 1024
IN_MEMORY = 8 * BATCH
SILENT_SECONDS = 30.0
"""Silence within a body after which the connection counts as lost: a network that failed sends no sign of it."""


class Exchange:
    """One request: its body, its upload, its principal, and headers for the answer."""

    def __init__(self, receive: Receive, method: str) -> None:
        self._receive = receive
        self._method = method
        self._timeout: asyncio.Timeout | None = None
        self._since = 0.0
        self._spool: tempfile.SpooledTemporaryFile[bytes] | None = None
        self.principal: Principal | None = None
        self.upload: Upload | None = None
        self.checksum: tuple[str, bytes] | None = None
        self.headers: dict[str, str] = {}

    @property
    def connection(self) -> Receive:
        """What tells that the client has gone, once the body has been read."""
        return self._receive

    async def receive(self) -> Message:
        """Return the next message: of a body that was checked before, or of the connection."""
        if self._spool is not None:
            piece = await asyncio.to_thread(self._spool.read, BATCH)
            if not piece:
                self._spool.close()
                self._spool = None
            return {"type": "http.request", "body": piece, "more_body": bool(piece)}
        if self._method != "PATCH":
            return await self._receive()
        try:
            async with asyncio.timeout(SILENT_SECONDS) as self._timeout:
                self._since = asyncio.get_running_loop().time()
                return await self._receive()
        except TimeoutError:
            return {"type": "http.disconnect"}
        finally:
            self._timeout = None

    def silent_seconds(self) -> float:
        """Return for how long the request has waited without receiving anything."""
        return 0.0 if self._timeout is None else asyncio.get_running_loop().time() - self._since

    def abandon(self) -> None:
        """Treat the connection as lost."""
        if self._timeout is not None:
            self._timeout.reschedule(asyncio.get_running_loop().time())

    async def verify(self, most: int, folder: Path) -> None:
        """Receive the whole body, at most ``most`` bytes, into a temporary file; pass it on if its checksum is right.

        Raises:
            ChecksumMismatchError: its checksum is another one.
            UploadConflictError: it is too long, or the connection broke.
            StorageFullError: the temporary file does not fit.
        """
        assert self.checksum is not None
        algorithm, expected = self.checksum
        digest, size = hashlib.new(algorithm, usedforsecurity=False), 0
        spool = tempfile.SpooledTemporaryFile[bytes](max_size=IN_MEMORY, dir=str(folder))
        try:
            more = True
            while more:
                message = await self.receive()
                if message["type"] == "http.disconnect":
                    raise UploadConflictError("The connection broke.", advice="Send the chunk again.")
                piece, more = message.get("body", b""), message.get("more_body", False)
                size += len(piece)
                if size > most:
                    raise too_long()
                digest.update(piece)
                with disk_errors(folder):
                    await asyncio.to_thread(spool.write, piece)
            if digest.digest() != expected:
                raise ChecksumMismatchError(
                    f"The chunk's {algorithm} is another one.", advice="Send the chunk again.", algorithm=algorithm
                )
            spool.seek(0)
        except BaseException:
            spool.close()
            raise
        self._spool = spool

    def close(self) -> None:
        """Discard the part that was not read."""
        if self._spool is not None:
            self._spool.close()


_EXCHANGE: ContextVar[Exchange] = ContextVar("exchange")


def exchange() -> Exchange:
    """Return the exchange of the current request."""
    return _EXCHANGE.get()


def too_long() -> UploadConflictError:
    """Make the error for more bytes than announced."""
    return UploadConflictError("There are more bytes than Upload-Length says.", advice="Send what is missing only.")


def parsed_checksum(given: str) -> tuple[str, bytes]:
    """Return algorithm and digest of an Upload-Checksum header. Raises ChecksumInvalidError."""
    algorithm, _, encoded = given.strip().partition(" ")
    try:
        if algorithm not in ALGORITHMS:
            raise ValueError
        digest = base64.b64decode(encoded, validate=True)
        if len(digest) != hashlib.new(algorithm, usedforsecurity=False).digest_size:
            raise ValueError
    except (ValueError, binascii.Error) as error:
        raise ChecksumInvalidError(
            "Upload-Checksum names an algorithm that is not served, or its digest does not read.",
            advice=f"Give one of {', '.join(ALGORITHMS)}, a space, and the digest in base64.",
            field="Upload-Checksum",
        ) from error
    return algorithm, digest


def http_date(upload: Upload) -> str:
    """Return when an upload expires, as HTTP writes dates."""
    return format_datetime(upload.expires_at, usegmt=True)


class TusMiddleware:
    """Middleware that makes the exchange, and corrects requests to the library and its answers."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        path = scope.get("path", "")
        if scope["type"] != "http" or not (path == PREFIX or path.startswith(PREFIX + "/")):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        override = headers.get("x-http-method-override", "").upper()
        if scope["method"] == "POST" and override in ("PATCH", "DELETE"):
            scope["method"] = override
        dropped = (
            {b"x-http-method-override", b"upload-length"} if scope["method"] == "PATCH" else {b"x-http-method-override"}
        )
        scope["headers"] = [pair for pair in scope["headers"] if pair[0] not in dropped]
        if scope["method"] == "PATCH" and "content-length" not in headers:
            # A streamed body has none. The library refuses that, but only after having appended it.
            scope["headers"].append((b"content-length", b"0"))
        current = Exchange(receive, scope["method"])
        token = _EXCHANGE.set(current)

        async def send_corrected(message: Message) -> None:
            if message["type"] == "http.response.start":
                answer = MutableHeaders(raw=message.get("headers", []))
                answer["Tus-Resumable"] = VERSION
                if message["status"] == 412:
                    answer["Tus-Version"] = VERSION
                if scope["method"] == "HEAD":
                    del answer["Content-Length"]
                if message["status"] < 300:
                    answer.update(current.headers)
                message = {**message, "headers": answer.raw}
            await send(message)

        try:
            await self._app(scope, current.receive, send_corrected)
        finally:
            _EXCHANGE.reset(token)
            current.close()
