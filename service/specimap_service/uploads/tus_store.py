"""The storage interface of ``tuspyserver`` on our upload files, with database rows instead of its side files."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from tuspyserver.storage import TusStorage

from specimap_core.atomic import disk_errors
from specimap_core.errors import NotFoundError, SpecimapError
from specimap_infra.errors import StorageUnavailableError
from specimap_infra.tables import Upload
from specimap_service.auth.keys import Principal
from specimap_service.uploads.files import POLL_SECONDS, Appender, UploadBytes, busy
from specimap_service.uploads.lifecycle import check_alive
from specimap_service.uploads.tus import BATCH, Exchange, exchange, http_date

TAKEOVER_SECONDS = 2.0
"""Silence after which another request for the same upload may take over."""
LOCK_SECONDS = 7.0
"""How long a request waits for a locked upload: longer than a dead process keeps it."""


class _Locked:
    """A locked upload that a request appends to. ``error``: why a write failed."""

    def __init__(self, appender: Appender, holder: Exchange) -> None:
        self.holder = holder
        self.pending = bytearray()
        self.error: SpecimapError | None = None
        self._appender = appender
        self._lock = threading.Lock()

    def write(self, folder: Path, *, sync: bool) -> int:
        """Append the pending bytes; return how many. Raises StorageFullError, StorageUnavailableError."""
        with self._lock:
            data, self.pending = self.pending, bytearray()
            try:
                with disk_errors(folder), memoryview(data) as view:
                    at = 0
                    while at < len(view):
                        at += self._appender.write(view[at:])
                    if sync:
                        self._appender.sync()
            except SpecimapError as error:
                self.error = error
                raise
            except OSError as error:
                self.error = StorageUnavailableError("The bytes cannot be written.", advice="Try again later.")
                raise self.error from error
            return len(data)

    def close(self) -> None:
        """Release the lock, after a write that a cancelled request may have left unfinished; does not wait for that."""
        if self._lock.acquire(blocking=False):
            self._appender.close()
            self._lock.release()
            return
        threading.Thread(target=self._close_after_write, daemon=True).start()

    def _close_after_write(self) -> None:
        with self._lock:
            self._appender.close()


class UploadStore(TusStorage):
    """The library's storage interface on :class:`UploadBytes`. Uploads are described by rows, not by side files."""

    def __init__(
        self,
        files: UploadBytes,
        *,
        received: Callable[[int], None],
        delete: Callable[[str, Principal], None],
        renewed: Callable[[Upload], Upload],
    ) -> None:
        self._files, self._received, self._delete, self._renewed = files, received, delete, renewed
        self._locked: dict[str, _Locked] = {}

    async def create(self, uid: str) -> None:
        """Do nothing: the file was created before the row."""

    async def exists(self, uid: str) -> bool:
        """Return whether the request's upload has a file, or had a complete one."""
        upload = await self._renew()
        return upload is not None and (upload.state != "open" or await self._size(uid) is not None)

    async def _renew(self) -> Upload | None:
        """Return the request's upload as it stands. Raises UploadGoneError where it was ended meanwhile."""
        current = exchange()
        if current.upload is not None and current.upload.state == "open":
            current.upload = await asyncio.to_thread(self._renewed, current.upload)
            check_alive(current.upload)
        return current.upload

    async def size(self, uid: str) -> int:
        """Return the bytes that have arrived."""
        upload = exchange().upload
        if upload is not None and upload.state != "open":
            return upload.size
        return await self._size(uid) or 0

    async def _size(self, uid: str) -> int | None:
        return await asyncio.to_thread(self._files.size, uid)

    async def append(self, uid: str, chunk: bytes) -> None:
        """Take a piece; it is written together with others."""
        held = self._locked[uid]
        held.pending += chunk
        if len(held.pending) >= BATCH:
            await asyncio.to_thread(self._write, held, sync=False)

    async def flush(self, uid: str) -> None:
        """Write everything to disk."""
        if uid in self._locked:
            await asyncio.to_thread(self._write, self._locked[uid], sync=True)

    def _write(self, held: _Locked, *, sync: bool) -> None:
        # Raised again when the lock is released: the library would answer a failure here with success.
        self._received(held.write(self._files.folder, sync=sync))

    async def finalize(self, uid: str) -> None:
        """Do nothing: the completion hook finishes a whole file."""

    async def read(self, uid: str) -> bytes | None:
        """Return nothing; the library is never asked to read."""
        return None

    async def delete(self, uid: str) -> None:
        """End the upload."""
        principal = exchange().principal
        assert principal is not None
        async with self.lock(uid):
            await asyncio.to_thread(self._delete, uid, principal)

    async def read_info(self, uid: str) -> dict[str, Any] | None:
        """Return what the library would keep in a side file; without names, since it logs them."""
        upload = exchange().upload
        if upload is None:
            return None
        return {
            "metadata": {"filename": uid, "filetype": "application/octet-stream"},
            "size": upload.size,
            "offset": await self.size(uid),
            "created_at": upload.created_at.isoformat(),
            "expires": http_date(upload) if upload.state == "open" else None,
        }

    async def write_info(self, uid: str, data: dict[str, Any]) -> None:
        """Do nothing: the row and the file's size hold everything."""

    async def list_uids(self) -> list[str]:
        """Return nothing; the library is never asked to list."""
        return []

    def location(self, uid: str) -> str:
        """Return the id, which the completion hook needs."""
        return uid

    @asynccontextmanager
    async def lock(self, uid: str) -> AsyncIterator[None]:  # type: ignore[override]
        """Hold the upload's file. A request on it that has fallen silent is ended.

        Raises:
            NotFoundError, UploadLockedError: the file cannot be locked.
            StorageFullError, StorageUnavailableError: at the end, where a write failed.
        """
        upload = exchange().upload
        if upload is not None and upload.state != "open":
            yield
            return
        clock = asyncio.get_running_loop().time
        deadline = clock() + LOCK_SECONDS
        while True:
            try:
                appender = await asyncio.to_thread(self._files.try_lock, uid)
            except NotFoundError:
                # Another request has finished it while this one waited: its offset is its length now.
                upload = await self._renew()
                if upload is None or upload.state == "open":
                    raise
                yield
                return
            if appender is not None:
                break
            other = self._locked.get(uid)
            if other is not None and other.holder.silent_seconds() > TAKEOVER_SECONDS:
                other.holder.abandon()
            if clock() > deadline:
                raise busy()
            await asyncio.sleep(POLL_SECONDS)
        held = self._locked[uid] = _Locked(appender, exchange())
        appender.when_wanted(_giving_way(asyncio.get_running_loop(), held.holder))
        try:
            yield
        finally:
            del self._locked[uid]
            held.close()
        if held.error is not None:
            raise held.error


def _giving_way(loop: asyncio.AbstractEventLoop, holder: Exchange) -> Callable[[], None]:
    """Make what ends a request that has fallen silent, from any thread."""

    def give_way() -> None:
        if holder.silent_seconds() > TAKEOVER_SECONDS:
            holder.abandon()

    def soon() -> None:
        with suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(give_way)

    return soon
