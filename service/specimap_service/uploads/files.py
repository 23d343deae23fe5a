"""Bytes of unfinished uploads: one file each on a local disk, locked by the request that writes to it.

The file's size is the offset: a process killed in the middle of a write leaves a shorter file with the right bytes.
Where several machines serve, :mod:`specimap_service.uploads.parts` stands in for it.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Protocol

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors, remove
from specimap_infra.database import utc_now
from specimap_infra.ids import PATTERN
from specimap_infra.tables import Upload
from specimap_service.auth.access import no_upload
from specimap_service.errors import UploadLockedError

POLL_SECONDS = 0.05


class Appender(Protocol):
    """An upload that is locked, to be appended to; from one thread at a time."""

    def write(self, piece: memoryview) -> int:
        """Take bytes, as many as it returns."""

    def sync(self) -> None:
        """Keep what was taken, whatever happens to this machine's power."""

    def close(self) -> None:
        """Release the lock."""

    def when_wanted(self, call: Callable[[], None]) -> None:
        """Let ``call`` be called, from any thread, when a request on another machine waits for the lock."""


class UploadBytes(Protocol):
    """The bytes of unfinished uploads, by upload id. All methods block."""

    @property
    def folder(self) -> Path:
        """A folder on a local disk, for what is under way."""

    def create(self, upload_id: str) -> None:
        """Make place for a new upload."""

    def size(self, upload_id: str) -> int | None:
        """Return the bytes that have arrived; None where there is no such unfinished upload."""

    def coming(self, session: Session) -> int:
        """Count the bytes for which open uploads still need place on the local disk."""

    def remove(self, upload_id: str) -> None:
        """Remove the bytes, if there are any."""

    def try_lock(self, upload_id: str) -> Appender | None:
        """Lock an upload; None where it is locked. Raises NotFoundError where there is no such unfinished upload."""

    def whole(self, upload_id: str) -> AbstractContextManager[Path]:
        """Give a file with all bytes of an upload that is locked, which the block may move away."""

    def sweep(self, known: set[str], seconds: float) -> None:
        """Remove what belongs to no upload of ``known`` and was last written more than ``seconds`` ago."""


def check_id(upload_id: str) -> None:
    """Raise NotFoundError where the text is not an upload's id."""
    if not (upload_id.startswith("up_") and PATTERN.match(upload_id)):
        raise no_upload()


@contextmanager
def locked(uploads: UploadBytes, upload_id: str, seconds: float) -> Iterator[None]:
    """Hold the lock. Raises NotFoundError, and UploadLockedError where it is not free within ``seconds``."""
    deadline = time.monotonic() + seconds
    while (held := uploads.try_lock(upload_id)) is None:
        if time.monotonic() > deadline:
            raise busy()
        time.sleep(POLL_SECONDS)
    try:
        yield
    finally:
        held.close()


class _File:
    """An open file that is locked as long as it is open."""

    def __init__(self, handle: int) -> None:
        self._handle = handle

    def write(self, piece: memoryview) -> int:
        return os.write(self._handle, piece)

    def sync(self) -> None:
        os.fdatasync(self._handle)

    def close(self) -> None:
        os.close(self._handle)
        # A later write then fails instead of reaching another file of the same number.
        self._handle = -1

    def when_wanted(self, call: Callable[[], None]) -> None:
        """No other machine has this file."""


class UploadFiles:
    """Files of unfinished uploads in one folder, by upload id."""

    def __init__(self, folder: Path) -> None:
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.folder = folder

    def path(self, upload_id: str) -> Path:
        """Return the path of an upload's file. Raises NotFoundError where the text is not an upload's id."""
        check_id(upload_id)
        return self.folder / upload_id

    def create(self, upload_id: str) -> None:
        """Create an empty file. Raises StorageFullError."""
        path = self.path(upload_id)
        with disk_errors(path):
            os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600))

    def size(self, upload_id: str) -> int | None:
        """Return the bytes that have arrived; None where there is no file."""
        try:
            return self.path(upload_id).stat().st_size
        except FileNotFoundError:
            return None

    def coming(self, session: Session) -> int:
        """Count the bytes that open uploads have still to send."""
        rows = session.execute(
            sa.select(Upload.id, Upload.size).where(Upload.state == "open", Upload.expires_at > utc_now())
        )
        return sum(max(0, size - (self.size(upload_id) or 0)) for upload_id, size in rows)

    def remove(self, upload_id: str) -> None:
        """Remove the file, if there is one."""
        self.path(upload_id).unlink(missing_ok=True)

    def try_lock(self, upload_id: str) -> Appender | None:
        """Lock the file; None if it is locked.

        Raises:
            NotFoundError: there is no file.
        """
        path = self.path(upload_id)
        try:
            handle = os.open(path, os.O_RDWR | os.O_APPEND)
        except FileNotFoundError as error:
            raise no_upload() from error
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.fstat(handle).st_nlink:
                return _File(handle)
        except BlockingIOError:
            os.close(handle)
            return None
        # The file was removed between opening and locking.
        os.close(handle)
        raise no_upload()

    @contextmanager
    def whole(self, upload_id: str) -> Iterator[Path]:
        """Give the file by a second name; the first is removed after the commit, so that a crash loses nothing."""
        path = self.path(upload_id)
        aside = path.with_suffix(".whole")
        with disk_errors(aside):
            aside.unlink(missing_ok=True)
            os.link(path, aside)
        try:
            yield aside
        finally:
            remove(aside)

    def sweep(self, known: set[str], seconds: float) -> None:
        """Remove files that belong to no upload of ``known`` and were last written more than ``seconds`` ago."""
        for path in self.folder.iterdir():
            with suppress(FileNotFoundError):
                if path.name.partition(".")[0] not in known and time.time() - path.stat().st_mtime > seconds:
                    remove(path)


def busy() -> UploadLockedError:
    """Make the error for a locked upload."""
    return UploadLockedError(
        "Another request is writing to this upload.", advice="Ask for the offset with HEAD in a second, and go on."
    )
