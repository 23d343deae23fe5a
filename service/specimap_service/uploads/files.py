"""Files of unfinished uploads: one each on a local disk, locked by the request that writes to it.

The file's size is the offset: a process killed in the middle of a write leaves a shorter file with the right bytes.
"""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from specimap_core.atomic import disk_errors
from specimap_infra.ids import PATTERN
from specimap_service.auth.access import no_upload
from specimap_service.errors import UploadLockedError

POLL_SECONDS = 0.05


class UploadFiles:
    """Files of unfinished uploads in one folder, by upload id."""

    def __init__(self, folder: Path) -> None:
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        self.folder = folder

    def path(self, upload_id: str) -> Path:
        """Return the path of an upload's file. Raises NotFoundError where the text is not an upload's id."""
        if not (upload_id.startswith("up_") and PATTERN.match(upload_id)):
            raise no_upload()
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

    def remove(self, upload_id: str) -> None:
        """Remove the file, if there is one."""
        self.path(upload_id).unlink(missing_ok=True)

    def try_lock(self, upload_id: str) -> int | None:
        """Lock the file; return a descriptor to append with, which holds the lock until closed; None if it is locked.

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
                return handle
        except BlockingIOError:
            os.close(handle)
            return None
        # The file was removed between opening and locking.
        os.close(handle)
        raise no_upload()

    @contextmanager
    def locked(self, upload_id: str, seconds: float) -> Iterator[None]:
        """Hold the lock. Raises NotFoundError, and UploadLockedError where it is not free within ``seconds``."""
        deadline = time.monotonic() + seconds
        while (handle := self.try_lock(upload_id)) is None:
            if time.monotonic() > deadline:
                raise busy()
            time.sleep(POLL_SECONDS)
        try:
            yield
        finally:
            os.close(handle)

    def abandoned(self, known: set[str], seconds: float) -> list[Path]:
        """List files that belong to no upload of ``known`` and were last written more than ``seconds`` ago."""
        found = []
        for path in self.folder.iterdir():
            with suppress(FileNotFoundError):
                if path.name.partition(".")[0] not in known and time.time() - path.stat().st_mtime > seconds:
                    found.append(path)
        return found


def busy() -> UploadLockedError:
    """Make the error for a locked upload."""
    return UploadLockedError(
        "Another request is writing to this upload.", advice="Ask for the offset with HEAD in a second, and go on."
    )
