"""Files that only the user of the service may read, in whatever folder they lie."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

JOURNALS = ("-wal", "-shm", "-journal")
"""What SQLite keeps next to its file; new ones get the rights of the file."""


def make_private(database: Path) -> None:
    """Create a file of SQLite if it is missing, and take it and its journals away from other users.

    Where the group may write it, programs of other users share it on purpose: the group keeps its access.

    Raises:
        OSError: it cannot be created.
    """
    if not database.exists():
        os.close(os.open(database, os.O_RDONLY | os.O_CREAT, 0o600))
    for path in (database, *(database.with_name(database.name + ending) for ending in JOURNALS)):
        # A journal may go at any time, and a file of another user is for that one to protect.
        with suppress(FileNotFoundError, PermissionError):
            mode = stat.S_IMODE(path.stat().st_mode)
            kept = mode & (0o770 if mode & stat.S_IWGRP else 0o700)
            if kept != mode:
                path.chmod(kept)
