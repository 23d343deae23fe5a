"""Making a backup while the service runs."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from specimap_core import __version__
from specimap_core.atomic import atomic_path, remove
from specimap_core.errors import CancelledError, NotFoundError, OutputExistsError
from specimap_infra.backup.manifest import (
    FILES,
    FORMAT,
    LIST,
    MANIFEST,
    ROWS,
    Cancelled,
    Entry,
    Manifest,
    Progress,
    digest_of,
    hashed,
    read_entries,
    read_manifest,
)
from specimap_infra.backup.rows import Snapshot, dump_rows
from specimap_infra.database import Database, utc_now
from specimap_infra.references import Reference
from specimap_infra.storage import Storage

ROUNDS = 10
"""Snapshots after which files that are gone count as missing, however many are deleted meanwhile."""


def create_backup(
    database: Database,
    storage: Storage,
    target: Path,
    *,
    previous: Path | None = None,
    progress: Progress = lambda *_: None,
    cancelled: Cancelled = lambda: False,
) -> Manifest:
    """Copy the database's rows and the files they refer to into a new folder, which appears when it is whole.

    Stored files do not change, so they are copied after the rows were read. Where some were deleted meanwhile, the rows
    are read anew, until they refer to nothing that is gone.

    Args:
        previous: an earlier backup; files that it holds are linked to it where the file system can.

    Raises:
        OutputExistsError: there is something at ``target``.
        CancelledError: ``cancelled`` came true; nothing is left.
        DatabaseTooNewError, SettingsError: as of ``dump_rows``.
        DatabaseUnavailableError, StorageUnavailableError, StorageFullError, OutputNotWritableError.
    """
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise OutputExistsError(f"{target} exists.", advice="Name a folder that does not exist yet.")
    with atomic_path(target) as aside:
        # Hashes of keys and secrets of webhooks are in it.
        aside.mkdir(mode=0o700)
        copy = _Copy(storage, aside / FILES, progress, cancelled)
        if previous is not None:
            copy.earlier = {e.key: e for e in read_entries(previous, read_manifest(previous))}
            copy.earlier_files = previous / FILES
        gone: set[str] = set()
        for _ in range(ROUNDS):
            snapshot = dump_rows(database, aside / ROWS, cancelled)
            copy.check()
            gone, before = copy.all_of(snapshot), gone
            if gone <= before:
                break
        manifest = _described(aside, snapshot, copy, gone)
        # Flushed in one go: a result has thousands of small files.
        os.sync()
    return manifest


def _described(aside: Path, snapshot: Snapshot, copy: _Copy, gone: set[str]) -> Manifest:
    entries = sorted(copy.entries(snapshot), key=lambda entry: entry.key)
    with open(aside / LIST, "w", encoding="utf-8") as file:
        file.writelines(entry.model_dump_json() + "\n" for entry in entries)
    manifest = Manifest(
        format=FORMAT,
        program=__version__,
        made_at=utc_now(),
        revision=snapshot.revision,
        rows=snapshot.rows,
        rows_sha256=digest_of(aside / ROWS),
        files=len(entries),
        bytes=sum(entry.size for entry in entries),
        files_sha256=digest_of(aside / LIST),
        missing=sorted(gone),
        damaged=sorted(copy.damaged),
    )
    (aside / MANIFEST).write_text(manifest.model_dump_json(indent=1), encoding="utf-8")
    return manifest


@dataclass
class _Copy:
    """Files copied so far."""

    storage: Storage
    folder: Path
    progress: Progress
    cancelled: Cancelled
    done: dict[str, list[Entry]] = field(default_factory=dict)
    """Files by what a row refers to."""
    damaged: set[str] = field(default_factory=set)
    earlier: dict[str, Entry] = field(default_factory=dict)
    earlier_files: Path | None = None

    def check(self) -> None:
        """Raise CancelledError where a stop was requested."""
        if self.cancelled():
            raise CancelledError("The backup was stopped; nothing of it is left.", advice="Give the command again.")

    def all_of(self, snapshot: Snapshot) -> set[str]:
        """Copy what is not copied yet; return the keys of what is not there."""
        wanted = {reference.key: reference for reference in snapshot.references}
        for key in self.done.keys() - wanted.keys():
            # Deleted since it was copied.
            remove(self.folder / key)
            del self.done[key]
            self.damaged.discard(key)
        total, past, gone = sum(max(r.size, 1) for r in wanted.values()), 0, set()
        for reference in wanted.values():
            self.check()
            if reference.key not in self.done and not self._copy(reference):
                gone.add(reference.key)
            past += max(reference.size, 1)
            self.progress("files", past / total)
        return gone

    def entries(self, snapshot: Snapshot) -> Iterator[Entry]:
        """Yield the files that the rows refer to."""
        for key in {reference.key for reference in snapshot.references}:
            yield from self.done.get(key, ())

    def _copy(self, reference: Reference) -> bool:
        """Copy a file or a folder; false where it is not there as a whole."""
        try:
            if reference.folder:
                keys = [item.key for item in self.storage.list(reference.key)]
            else:
                keys = [reference.key]
            entries = [self._file(key) for key in keys]
        except NotFoundError:
            entries = []
        # A folder that is being deleted may be there in part.
        if not entries or (reference.folder and sum(entry.size for entry in entries) < reference.size):
            remove(self.folder / reference.key)
            return False
        if reference.sha256 and entries[0].sha256 != reference.sha256:
            self.damaged.add(reference.key)
        self.done[reference.key] = entries
        return True

    def _file(self, key: str) -> Entry:
        target = self.folder / key
        target.parent.mkdir(parents=True, exist_ok=True)
        known = self.earlier.get(key)
        if known is not None and self.earlier_files is not None and self.storage.stat(key).size == known.size:
            try:
                os.link(self.earlier_files / key, target)
                return known
            except OSError:
                pass  # on another disk, or lost: copied
        target.unlink(missing_ok=True)
        size, digest = hashed(self.storage.stream(key), target, self.cancelled)
        return Entry(key=key, size=size, sha256=digest)
