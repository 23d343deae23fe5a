"""Notes on this machine's disk that show which workers live: a note is locked as long as its worker does.

A lock ends with its process, in whatever container it ran and however it ended; process ids repeat. So the death of a
worker of this machine is certain at once, where leases have to run out.
"""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path
from typing import TextIO

from specimap_core.atomic import disk_errors, remove
from specimap_workers.executors import suffix_of


class Presence:
    """The note of one worker, and those of others in the same folder."""

    def __init__(self, folder: Path, executor: str) -> None:
        self._folder = folder
        self._executor = executor
        self._note: TextIO | None = None

    def announce(self) -> None:
        """Write and lock the note, which lasts until this process ends."""
        suffix = suffix_of(self._executor)
        with disk_errors(self._folder):
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            # Locked before it has its name: nobody finds it unlocked.
            aside = self._folder / f".{suffix}.tmp"
            self._note = open(aside, "w", encoding="ascii")  # noqa: SIM115 - open until the end
            fcntl.flock(self._note, fcntl.LOCK_EX)
            self._note.write(self._executor)
            self._note.flush()
            os.rename(aside, self._folder / f"{suffix}.lock")

    def beat(self) -> None:
        """Show that this worker not only exists but gets on: its note is as old as its last beat."""
        if self._note is not None:
            os.utime(self._note.fileno())

    def dead(self) -> list[str]:
        """Return the executors of this machine that have ended and whose notes are still there."""
        return [executor for path in self._folder.glob("*.lock") if (executor := _ended(path)) is not None]

    def forget(self, executor: str) -> None:
        """Remove a dead executor's folders, then its note."""
        suffix = suffix_of(executor)
        for folder in self._folder.glob(f"*.{suffix}"):
            remove(folder)
        remove(self._folder / f"{suffix}.lock")


def living(folder: Path) -> list[tuple[str, float]]:
    """Return the executors whose notes in a folder are locked, each with the time of its last beat (Unix, s)."""
    found = []
    for path in folder.glob("*.lock"):
        with suppress(OSError), open(path, encoding="ascii") as note:
            try:
                fcntl.flock(note, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                found.append((note.read() or path.stem, os.fstat(note.fileno()).st_mtime))
    return found


def _ended(path: Path) -> str | None:
    """The executor of a note that nobody locks; None where it lives, or the note has gone."""
    with suppress(OSError), open(path, encoding="ascii") as note:
        fcntl.flock(note, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Notes of earlier versions are empty: what is in their names does for the folders.
        return note.read() or path.stem
    return None
