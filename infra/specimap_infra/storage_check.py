"""Comparison of the storage with the rows that refer to it, and its repair."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import CancelledError, NotFoundError
from specimap_infra.backup.manifest import Cancelled, Entry, Progress, read_entries, read_manifest
from specimap_infra.backup.restore import restore_file
from specimap_infra.database import Database, utc_now
from specimap_infra.references import PLACES, REMAKEABLE, Reference, column_of, references
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage, Stored
from specimap_infra.strays import UPLOADS, everything, is_own, leads_to, move_aside
from specimap_infra.tables import FINAL_STATES, Base, Export, Job, Upload, UploadPart

SAFE_HOURS = 24.0
"""Age below which a file that no row refers to may be one whose row is about to be written."""


@dataclass
class Findings:
    """What a check has found."""

    files: int = 0
    orphans: list[Stored] = field(default_factory=list)
    """Files that no row refers to, of a safe age."""
    strays: list[Stored] = field(default_factory=list)
    """What Specimap has not put there, of a safe age: in another folder, under a strange name, or a link."""
    young: int = 0
    """Files that no row refers to, and that may still get one."""
    missing: list[Reference] = field(default_factory=list)
    """What rows refer to and the storage lacks, as a whole or in part."""
    damaged: list[Reference] = field(default_factory=list)
    """Files with another checksum than when they were uploaded."""

    @property
    def clean(self) -> bool:
        """Whether there is nothing to repair."""
        return not (self.orphans or self.strays or self.missing or self.damaged)


@dataclass
class Repaired:
    """What a repair has done."""

    removed: list[str] = field(default_factory=list)
    """Files that no row referred to."""
    moved: dict[str, str] = field(default_factory=dict)
    """Where strays lie now, by their keys before."""
    forgotten: list[str] = field(default_factory=list)
    """Files that are made again on demand, since their rows are gone."""
    brought_back: list[str] = field(default_factory=list)
    """Files from the backup."""
    left: list[str] = field(default_factory=list)
    """What only a backup that holds it could bring back."""


def check_storage(
    database: Database,
    storage: Storage,
    *,
    safe_hours: float = SAFE_HOURS,
    checksums: bool = False,
    progress: Progress = lambda *_: None,
    cancelled: Cancelled = lambda: False,
) -> Findings:
    """Compare, while the service runs; changes nothing.

    ``checksums``: read every uploaded file too.

    Raises:
        CancelledError: ``cancelled`` came true.
        DatabaseUnavailableError, StorageUnavailableError.
    """
    oldest = utc_now() - datetime.timedelta(hours=safe_hours)
    # The files before the rows: a file is stored before its row is written.
    there = {item.key: item for item in everything(storage)}
    with database.session() as session:
        referred = list(references(session))
        known = {reference.key for reference in referred} | _parts(session)
        going_on = _going_on(session)
    findings = Findings(files=sum(key.partition("/")[0] in PLACES for key in there))
    for item in there.values():
        if _is_known(item.key, known) or _is_way(storage, item.key, known):
            continue
        if item.modified >= oldest or item.key.startswith(going_on):
            findings.young += 1
        elif is_own(storage, item.key):
            findings.orphans.append(item)
        else:
            findings.strays.append(item)
    folders = _sizes(there, {reference.key for reference in referred if reference.folder})
    for number, reference in enumerate(referred):
        if cancelled():
            raise CancelledError("The check was stopped.", advice="Give the command again.")
        if not _is_whole(reference, there, folders) and not _is_there(database, storage, reference):
            findings.missing.append(reference)
        elif checksums and reference.sha256 and not _is_undamaged(database, storage, reference):
            findings.damaged.append(reference)
        progress("check", (number + 1) / len(referred))
    return findings


def repair_storage(
    database: Database,
    storage: Storage,
    settings: ServiceSettings,
    findings: Findings,
    *,
    backup: Path | None = None,
    cancelled: Cancelled = lambda: False,
) -> Repaired:
    """Mend what a check has found.

    Files that no row refers to are removed; strays are moved aside, since they are not Specimap's to remove. What is
    missing comes from the backup; where that has none, rows of files that can be made again are removed, and everything
    else stays as it is.

    Raises:
        CancelledError: ``cancelled`` came true; what was mended stays so.
        BackupInvalidError: the backup is not as it was made.
        DatabaseUnavailableError, StorageUnavailableError, StorageFullError.
    """
    entries = read_entries(backup, read_manifest(backup)) if backup is not None else []
    done = Repaired()
    with database.session() as session:
        # Rows may have been written since the check.
        known = {reference.key for reference in references(session)} | _parts(session)
    for item in findings.strays:
        _check_stop(cancelled)
        if not _is_known(item.key, known) and (place := move_aside(storage, item.key)) is not None:
            done.moved[item.key] = place
    for item in findings.orphans:
        _check_stop(cancelled)
        if not _is_known(item.key, known):
            storage.delete(item.key)
            done.removed.append(item.key)
    for reference in (*findings.missing, *findings.damaged):
        _check_stop(cancelled)
        found = _of(reference, entries)
        if backup is not None and found:
            for entry in found:
                if reference in findings.damaged or not _has(storage, entry):
                    restore_file(storage, settings, backup, entry, cancelled)
            done.brought_back.append(reference.key)
        elif reference.table in REMAKEABLE:
            _forget(database, reference)
            done.forgotten.append(reference.key)
        else:
            done.left.append(reference.key)
    return done


def _check_stop(cancelled: Cancelled) -> None:
    if cancelled():
        raise CancelledError("The repair was stopped.", advice="Give the command again.")


def _listed(storage: Storage, prefix: str) -> Iterator[Stored]:
    try:
        yield from storage.list(prefix)
    except NotFoundError:
        return


def _parts(session: Session) -> set[str]:
    """Parts of unfinished uploads."""
    return set(session.scalars(sa.select(UploadPart.storage_key)))


def _going_on(session: Session) -> tuple[str, ...]:
    """Folders in which files are stored whose rows come later: of jobs, exports and uploads that have not ended."""
    jobs = session.execute(sa.select(Job.id, Job.acquisition_id).where(Job.state.not_in(FINAL_STATES))).all()
    exports = session.scalars(sa.select(Export.id).where(Export.state.not_in(FINAL_STATES)))
    uploads = session.execute(sa.select(Upload.id, Upload.acquisition_id).where(Upload.state == "open")).all()
    acquisitions = {job.acquisition_id for job in jobs} | {upload.acquisition_id for upload in uploads}
    return (
        *(f"jobs/{job.id}/" for job in jobs),
        *(f"exports/{id}/" for id in exports),
        *(f"acquisitions/{id}/" for id in acquisitions),
        *(f"{UPLOADS}/{upload.id}/" for upload in uploads),
    )


def _parents(key: str) -> Iterator[str]:
    while "/" in key:
        key = key.rsplit("/", 1)[0]
        yield key


def _is_way(storage: Storage, key: str, known: set[str]) -> bool:
    """Whether an item is a link that a person made, through which files are reached that rows refer to."""
    return storage.folder is not None and (storage.folder / key).is_symlink() and leads_to(key, known)


def _is_known(key: str, known: set[str]) -> bool:
    return key in known or any(parent in known for parent in _parents(key))


def _sizes(there: Mapping[str, Stored], folders: set[str]) -> dict[str, int]:
    """Bytes in each of the folders that rows refer to."""
    sizes: dict[str, int] = {}
    for key, item in there.items():
        for parent in _parents(key):
            if parent in folders:
                sizes[parent] = sizes.get(parent, 0) + item.size
    return sizes


def _is_whole(reference: Reference, there: Mapping[str, Stored], folders: Mapping[str, int]) -> bool:
    if reference.folder:
        return folders.get(reference.key, -1) >= reference.size
    item = there.get(reference.key)
    return item is not None and (reference.size == 0 or item.size == reference.size)


def _is_there(database: Database, storage: Storage, reference: Reference) -> bool:
    """Look again: it may have been stored since the storage was listed, or deleted since the row was read."""
    items = {item.key: item for item in _listed(storage, reference.key)} if reference.folder else {}
    if not reference.folder:
        with suppress(NotFoundError):
            items[reference.key] = storage.stat(reference.key)
    if _is_whole(reference, items, _sizes(items, {reference.key})):
        return True
    return not _is_referred(database, reference)


def _is_referred(database: Database, reference: Reference) -> bool:
    column = column_of(reference.table)
    with database.session() as session:
        return session.scalar(sa.select(column).where(column == reference.key).limit(1)) is not None


def _is_undamaged(database: Database, storage: Storage, reference: Reference) -> bool:
    digest = hashlib.sha256()
    try:
        for piece in storage.stream(reference.key):
            digest.update(piece)
    except NotFoundError:
        return not _is_referred(database, reference)
    return digest.hexdigest() == reference.sha256


def _of(reference: Reference, entries: Sequence[Entry]) -> list[Entry]:
    inside = reference.key + "/"
    return [entry for entry in entries if entry.key == reference.key or entry.key.startswith(inside)]


def _has(storage: Storage, entry: Entry) -> bool:
    try:
        return storage.stat(entry.key).size == entry.size
    except NotFoundError:
        return False


def _forget(database: Database, reference: Reference) -> None:
    column = column_of(reference.table)
    with database.session() as session:
        session.execute(sa.delete(Base.metadata.tables[reference.table]).where(column == reference.key))
