"""Notes on the local disk that show which processes of this machine live, and whether they get on.

A note is locked as long as its process lives: a lock ends with its process, in whatever container it ran and however it
ended, where process ids repeat. A process touches its note now and then; one that lives and does not is silent.

A health check asks these notes, not the database: while that is away, processes wait for it, and an orchestrator that
ended them would only lose what they do.
"""

from __future__ import annotations

import fcntl
import os
import socket
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Self, TextIO

from specimap_core.atomic import disk_errors


class Note:
    """A process's own note, locked until it is closed or the process ends."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    @classmethod
    def leave(cls, folder: Path, name: str, process: str) -> Self:
        """Leave the note ``name`` of a process called ``host:...``.

        Raises:
            OutputNotWritableError, StorageFullError: the folder cannot be written.
        """
        with disk_errors(folder):
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            # Locked before it has its name: nobody finds it unlocked.
            aside = folder / f".{name}.tmp"
            file = open(aside, "w", encoding="ascii")  # noqa: SIM115 - open until the end
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(process)
            file.flush()
            os.rename(aside, folder / f"{name}.lock")
        return cls(file)

    def beat(self) -> None:
        """Show that the process not only lives but gets on."""
        os.utime(self._file.fileno())

    def close(self) -> None:
        """Give it up."""
        self._file.close()


@dataclass(frozen=True)
class Health:
    """Names of the processes that have beaten of late, and of those that live and have not."""

    lively: tuple[str, ...]
    silent: tuple[str, ...]

    @property
    def sound(self) -> bool:
        """Whether a process lives, and none has fallen silent."""
        return bool(self.lively) and not self.silent


def health_of(folder: Path, silent_seconds: float, host: str | None = None) -> Health:
    """Judge the processes of a host (by default this one) by their notes in a folder."""
    host = host or socket.gethostname()
    notes = {process: beat for process, beat in _living(folder) if process.startswith(f"{host}:")}
    oldest = time.time() - silent_seconds
    return Health(
        tuple(sorted(process for process, beat in notes.items() if beat >= oldest)),
        tuple(sorted(process for process, beat in notes.items() if beat < oldest)),
    )


def _living(folder: Path) -> list[tuple[str, float]]:
    """The processes whose notes are locked, each with the time of its last beat (Unix, s)."""
    found = []
    for path in folder.glob("*.lock"):
        with suppress(OSError), open(path, encoding="ascii") as note:
            try:
                fcntl.flock(note, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                found.append((note.read() or path.stem, os.fstat(note.fileno()).st_mtime))
    return found
