"""Which workers of this machine live, by their notes on its disk.

The death of a worker of this machine is certain at once, where leases have to run out.
"""

from __future__ import annotations

import fcntl
from contextlib import suppress
from pathlib import Path

from specimap_core.atomic import remove
from specimap_infra.heartbeats import Note
from specimap_workers.executors import suffix_of


class Presence:
    """The note of one worker, and those of others in the same folder."""

    def __init__(self, folder: Path, executor: str) -> None:
        self._folder = folder
        self._executor = executor
        self._note: Note | None = None

    def announce(self) -> None:
        """Write and lock the note, which lasts until this process ends."""
        self._note = Note.leave(self._folder, suffix_of(self._executor), self._executor)

    def beat(self) -> None:
        """Show that this worker not only lives but gets on."""
        if self._note is not None:
            self._note.beat()

    def dead(self) -> list[str]:
        """Return the executors of this machine that have ended and whose notes are still there."""
        return [executor for path in self._folder.glob("*.lock") if (executor := _ended(path)) is not None]

    def forget(self, executor: str) -> None:
        """Remove a dead executor's folders, then its note."""
        suffix = suffix_of(executor)
        for folder in self._folder.glob(f"*.{suffix}"):
            remove(folder)
        remove(self._folder / f"{suffix}.lock")


def _ended(path: Path) -> str | None:
    """The executor of a note that nobody locks; None where it lives, or the note has gone."""
    with suppress(OSError), open(path, encoding="ascii") as note:
        fcntl.flock(note, fcntl.LOCK_EX | fcntl.LOCK_NB)
        # Notes of earlier versions are empty: what is in their names does for the folders.
        return note.read() or path.stem
    return None
