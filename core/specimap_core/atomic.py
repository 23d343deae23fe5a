"""Atomic writes: write aside, flush, rename. A reader never sees a half-written file."""

from __future__ import annotations

import errno
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from specimap_core.errors import OutputNotWritableError, StorageFullError

UNWRITABLE = (
    errno.EACCES,
    errno.EPERM,
    errno.EROFS,
    errno.EEXIST,
    errno.ENOTDIR,
    errno.ENOENT,
    errno.ENAMETOOLONG,
    errno.ELOOP,
)


def name_as_text(path: Path) -> str:
    """A file's name for messages and reports: bytes that are no UTF-8, as on disks of other systems, become U+FFFD."""
    return os.fsencode(path.name).decode("utf-8", "replace")


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn the operating system's refusals while writing ``path`` into typed errors."""
    try:
        yield
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise StorageFullError(
                f"The disk filled up while writing {path.name}.",
                advice="Free space or choose another output folder; finished stages are kept.",
            ) from error
        if error.errno in UNWRITABLE:
            raise OutputNotWritableError(
                f"{path} cannot be written: {error.strerror}.",
                advice="Choose a folder that you may write to.",
            ) from error
        raise


@contextmanager
def atomic_path(target: Path) -> Iterator[Path]:
    """A path next to ``target`` to write a file or folder to; renamed onto ``target`` when the block succeeds.

    An existing file or folder at ``target`` is replaced. On failure what was written aside is removed.
    """
    aside = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
    with disk_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            yield aside
            replace(aside, target)
        finally:
            remove(aside)


def replace(aside: Path, target: Path) -> None:
    """Rename ``aside`` onto ``target``, which may be a non-empty folder."""
    if target.is_dir() and not target.is_symlink():
        # rename(2) refuses a non-empty folder: move the old one away first, remove it after.
        old = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}.tmp")
        os.rename(target, old)
        os.rename(aside, target)
        remove(old)
    else:
        os.replace(aside, target)


def remove_leftovers(folder: Path) -> None:
    """Remove what killed writers left aside in ``folder``; only one writer may work there at a time."""
    for path in folder.glob(".*.tmp"):
        remove(path)


def remove(path: Path) -> None:
    """Remove a file or folder if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def write_text(target: Path, text: str) -> None:
    """Write UTF-8 text atomically and flushed to the disk."""
    with atomic_path(target) as aside, open(aside, "w", encoding="utf-8") as f:
        f.write(text)
        f.flush()
        os.fsync(f.fileno())
