"""Stored files over HTTP: whole or one byte range, with ETags (RFC 9110), in constant memory."""

from __future__ import annotations

import asyncio
import hashlib
import os
import re
import stat
from pathlib import Path
from typing import Protocol
from urllib.parse import quote

from anyio import to_thread
from fastapi import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from specimap_core.errors import NotFoundError
from specimap_infra.errors import StorageUnavailableError
from specimap_infra.storage import Storage
from specimap_service.client_gone import disconnected
from specimap_service.errors import PreconditionFailedError, RangeNotSatisfiableError
from specimap_service.head_requests import only_head
from specimap_service.problems import problem_response

PIECE = 1024 * 1024
"""Bytes read at a time from a folder: two are in memory, one being sent and the next being read."""
BUCKET_PIECE = 8 * PIECE
CACHED = "private, max-age=300"
"""For content that never changes under its address; short, so that deleted content soon disappears from caches."""
REVALIDATED = "private, no-cache"
"""For content that may change: the client keeps it, but checks its ETag every time."""
VARY = "Authorization, Cookie"
"""Whoever signs out, or in with another key, gets nothing from the browser's cache."""
_RANGE = re.compile(r"^bytes=\s*(\d{0,18})\s*-\s*(\d{0,18})\s*$")
_TAG = re.compile(r'(?:W/)?"[^"]*"')


class _Source(Protocol):
    size: int
    etag: str
    piece: int

    def read(self, start: int, stop: int) -> bytes: ...


def ranged_response(
    request: Request, storage: Storage, key: str, media_type: str, filename: str | None = None, cache: str = CACHED
) -> Response:
    """Answer GET or HEAD of a stored file: 200, 206, 304, 412 or 416.

    Call it from a ``def`` endpoint, since it blocks. Several ranges at once, and ranges that are not of bytes, are
    answered with the whole file, as HTTP allows. ``filename`` makes it a download of that name; ``cache`` is the
    answer's Cache-Control.

    Raises:
        NotFoundError, StorageUnavailableError: before anything has been sent.
    """
    return _answer(request, _open(storage, key), media_type, filename, cache)


def ranged_bytes(request: Request, content: bytes, media_type: str, cache: str = REVALIDATED) -> Response:
    """Answer GET or HEAD of a document that was made rather than stored; its ETag is a hash."""
    return _answer(request, _InMemory(content), media_type, None, cache)


def known_to_client(request: Request, etag: str) -> bool:
    """Return whether If-None-Match names the quoted ETag: the answer is then 304."""
    known = request.headers.get("if-none-match")
    return known is not None and _matches(known, etag, weakly=True)


def names_tag(request: Request, etag: str) -> bool:
    """Return whether If-None-Match holds the quoted ETag itself; `*` needs to be known to exist first."""
    known = request.headers.get("if-none-match", "")
    return known.strip() != "*" and _matches(known, etag, weakly=True)


def _answer(request: Request, source: _Source, media_type: str, filename: str | None, cache: str) -> Response:
    etag = f'"{source.etag}"'
    headers = {"ETag": etag, "Cache-Control": cache, "Accept-Ranges": "bytes", "Vary": VARY}
    asked = request.headers
    if (wanted := asked.get("if-match")) is not None and not _matches(wanted, etag, weakly=False):
        return problem_response(
            PreconditionFailedError("The file is not the one that If-Match names.", advice="Read it anew."),
            None,
            **headers,
        )
    if known_to_client(request, etag):
        return Response(status_code=304, headers=headers)
    if filename is not None:
        plain = re.sub(r"[^A-Za-z0-9._-]", "_", filename)
        extended = "" if plain == filename else f"; filename*=UTF-8''{quote(filename, safe='')}"
        headers["Content-Disposition"] = f'attachment; filename="{plain}"{extended}'
    start, stop, status = 0, source.size, 200
    wanted_range = asked.get("range")
    # Ranges are defined for GET only; If-Range says: the range if the file is still this one, else all of it.
    if wanted_range is not None and not only_head(request) and asked.get("if-range", etag) == etag:
        try:
            found = _parsed(wanted_range, source.size)
        except RangeNotSatisfiableError as error:
            return problem_response(error, None, **headers, **{"Content-Range": f"bytes */{source.size}"})
        if found is not None:
            start, stop, status = *found, 206
            headers["Content-Range"] = f"bytes {start}-{stop - 1}/{source.size}"
    headers["Content-Length"] = str(stop - start)
    if only_head(request):
        return Response(None, status, headers, media_type)
    if stop - start <= PIECE:
        # This runs in a thread already: a small file needs no other.
        return Response(source.read(start, stop), status, headers, media_type)
    return _Streamed(source, start, stop, status, headers, media_type)


class _Streamed(Response):
    """An answer that sends a range piece by piece; while one is sent, a thread reads the next."""

    def __init__(
        self, source: _Source, start: int, stop: int, status: int, headers: dict[str, str], media_type: str
    ) -> None:
        super().__init__(None, status, headers, media_type)
        self._source, self._start, self._stop = source, start, stop

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the range; stop reading when the client disconnects."""
        await send({"type": "http.response.start", "status": self.status_code, "headers": self.raw_headers})
        gone = asyncio.ensure_future(disconnected(receive))
        ahead = self._read(self._start)
        try:
            at = self._start
            while at < self._stop and not gone.done():
                piece = await ahead
                at += len(piece)
                if at < self._stop:
                    ahead = self._read(at)
                await send({"type": "http.response.body", "body": piece, "more_body": at < self._stop})
        finally:
            gone.cancel()
            ahead.cancel()

    def _read(self, at: int) -> asyncio.Future[bytes]:
        stop = min(at + self._source.piece, self._stop)
        return asyncio.ensure_future(to_thread.run_sync(self._source.read, at, stop))


# ---- sources ------------------------------------------------------------------------------------------


def _open(storage: Storage, key: str) -> _Source:
    path = storage.path(key)
    return _InBucket(storage, key) if path is None else _InFolder(path)


class _InFolder:
    """An open file, sent as it was even if it is deleted or replaced meanwhile."""

    piece = PIECE

    def __init__(self, path: Path) -> None:
        self._handle = -1
        try:
            self._handle = os.open(path, os.O_RDONLY)
        except (FileNotFoundError, NotADirectoryError) as error:
            raise _missing() from error
        except OSError as error:
            raise StorageUnavailableError("The storage cannot be read.", advice="Try again later.") from error
        found = os.fstat(self._handle)
        if not stat.S_ISREG(found.st_mode):
            raise _missing()
        self.size = found.st_size
        self.etag = f"{found.st_ino:x}-{found.st_mtime_ns:x}-{found.st_size:x}"

    def read(self, start: int, stop: int) -> bytes:
        """Read the bytes from ``start`` up to ``stop``."""
        piece = os.pread(self._handle, stop - start, start)
        while len(piece) < stop - start:
            more = os.pread(self._handle, stop - start - len(piece), start + len(piece))
            if not more:
                raise StorageUnavailableError("A stored file became shorter while it was read.", advice="Try again.")
            piece += more
        return piece

    def __del__(self) -> None:
        # Not before the last reading thread has ended: the number of a closed file may be given to another one.
        if self._handle >= 0:
            os.close(self._handle)


class _InBucket:
    piece = BUCKET_PIECE

    def __init__(self, storage: Storage, key: str) -> None:
        found = storage.stat(key)
        self._storage, self._key = storage, key
        self.size, self.etag = found.size, found.etag

    def read(self, start: int, stop: int) -> bytes:
        """Read the bytes from ``start`` up to ``stop``."""
        return self._storage.read(self._key, start, stop)


class _InMemory:
    piece = PIECE

    def __init__(self, content: bytes) -> None:
        self._content = content
        self.size, self.etag = len(content), hashlib.sha256(content).hexdigest()[:32]

    def read(self, start: int, stop: int) -> bytes:
        """Read the bytes from ``start`` up to ``stop``."""
        return self._content[start:stop]


def _missing() -> NotFoundError:
    return NotFoundError("There is no such file.", advice="It may have been deleted.")


# ---- headers ------------------------------------------------------------------------------------------


def _matches(given: str, etag: str, *, weakly: bool) -> bool:
    tags = _TAG.findall(given)
    return given.strip() == "*" or etag in ([tag.removeprefix("W/") for tag in tags] if weakly else tags)


def _parsed(given: str, size: int) -> tuple[int, int] | None:
    """Return the first byte and the one after the last; None where the header is to be ignored."""
    found = _RANGE.match(given.strip())
    if found is None or found.group(1, 2) == ("", ""):
        return None
    first, last = found.group(1, 2)
    if not first:
        if int(last) and not size:
            return None
        start, stop = max(size - int(last), 0), size
    else:
        start, stop = int(first), min(int(last) + 1, size) if last else size
        if last and int(last) < start:
            return None
    if start >= size:
        raise RangeNotSatisfiableError(
            f"The file has {size} bytes; the range lies outside.", advice="Ask for bytes inside.", size=size
        )
    return start, stop
