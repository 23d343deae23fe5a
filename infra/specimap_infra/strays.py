"""All that lies in a storage, also what no program of Specimap put there."""

from __future__ import annotations

import datetime
import os
import stat
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path

import obstore

from specimap_core.errors import NotFoundError
from specimap_infra.database import utc_now
from specimap_infra.references import PLACES
from specimap_infra.storage import TEMPORARY, Storage, Stored
from specimap_infra.storage_errors import checked, store_errors

UPLOADS = "uploads"
"""Top folder of the parts of unfinished uploads."""
ASIDE = "strays"
"""Top folder of what a repair has moved aside. Nothing there is looked at again: a person decides."""
_OWN = frozenset({*PLACES, UPLOADS, TEMPORARY})


def everything(storage: Storage) -> Iterator[Stored]:
    """List all that lies in the storage but what was moved aside; in a folder also links and what is no file.

    Raises StorageUnavailableError.
    """
    if storage.folder is not None:
        yield from _below(storage.folder, "")
        return
    with store_errors(""):
        for batch in obstore.list(storage.store):
            for item in batch:
                if not item["path"].startswith(f"{ASIDE}/"):
                    yield Stored(item["path"], item["size"], item["e_tag"] or "", item["last_modified"])


def _below(folder: Path, prefix: str) -> Iterator[Stored]:
    try:
        entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
    except (FileNotFoundError, NotADirectoryError):
        # Removed meanwhile.
        return
    for entry in entries:
        key = prefix + entry.name
        if key == ASIDE:
            continue
        # A place of its own may lie on another disk, by a link.
        if entry.is_dir(follow_symlinks=key in PLACES):
            yield from _below(folder / entry.name, f"{key}/")
            continue
        with suppress(FileNotFoundError):
            found = entry.stat(follow_symlinks=False)
            changed = datetime.datetime.fromtimestamp(found.st_ctime, datetime.UTC)
            yield Stored(key, found.st_size, "", changed)


def is_own(storage: Storage, key: str) -> bool:
    """Whether an item is a file with a name as Specimap gives it, in one of its places."""
    try:
        own = key.partition("/")[0] in _OWN and "/" in key and checked(key) == key
    except NotFoundError:
        return False
    if not own or storage.folder is None:
        return own
    with suppress(FileNotFoundError):
        return stat.S_ISREG(os.lstat(storage.folder / key).st_mode)
    return True


def leads_to(key: str, known: Collection[str]) -> bool:
    """Whether an item is a link by which files are reached that rows refer to."""
    return any(name == key or name.startswith(f"{key}/") for name in known)


def move_aside(storage: Storage, key: str) -> str | None:
    """Move an item below ``strays/`` and the current time; its new key, or None where it has gone.

    Raises StorageUnavailableError, StorageFullError.
    """
    aside = f"{ASIDE}/{utc_now():%Y%m%dT%H%M%SZ}/{key}"
    with store_errors(key):
        try:
            if storage.folder is None:
                obstore.rename(storage.store, key, aside)
            else:
                target = storage.folder / aside
                target.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                os.rename(storage.folder / key, target)
        except FileNotFoundError:
            return None
    return aside
