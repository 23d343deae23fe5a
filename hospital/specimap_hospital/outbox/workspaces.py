"""Folders for DICOM objects under way. They hold patient data, so they go with whoever made them.

A folder is locked as long as its maker lives; one whose maker was killed is removed by the next.
"""

from __future__ import annotations

import fcntl
import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from specimap_core.atomic import disk_errors, remove

PREFIX, SUFFIX = "dicom-", ".tmp"
LOCK = "lock"


@contextmanager
def workspace(scratch: Path) -> Iterator[Path]:
    """Make a folder in the scratch folder for the time of the block, which only the user of the service may enter.

    Raises:
        StorageFullError, OutputNotWritableError: it cannot be made.
    """
    folder = scratch / f"{PREFIX}{uuid.uuid4().hex}{SUFFIX}"
    with disk_errors(folder):
        folder.mkdir(parents=True, mode=0o700)
        lock = os.open(folder / LOCK, os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield folder
    finally:
        remove(folder)
        os.close(lock)


def sweep(scratch: Path) -> int:
    """Remove the folders of makers that were killed. Returns how many."""
    gone = 0
    for folder in scratch.glob(f"{PREFIX}*{SUFFIX}"):
        with suppress(OSError):
            # Without a lock it is being made, or being removed.
            lock = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                remove(folder)
                gone += 1
            finally:
                os.close(lock)
    return gone
