"""Restoring a backup into an empty database and an empty storage."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from dbos import DBOS
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import CancelledError
from specimap_infra import jobs
from specimap_infra.backup.manifest import (
    FILES,
    ROWS,
    Cancelled,
    Entry,
    Manifest,
    Progress,
    changed,
    digest_of,
    hashed,
    pieces_of,
    read_entries,
    read_manifest,
)
from specimap_infra.backup.rows import load_rows
from specimap_infra.backup.target import refuse_rows, refuse_used_database, refuse_used_storage, sqlite_file
from specimap_infra.database import Database, database_errors
from specimap_infra.errors import BackupInvalidError
from specimap_infra.migrate import alembic_config, exclusive_lock, whole
from specimap_infra.postgres import unhurried
from specimap_infra.private_files import JOURNALS
from specimap_infra.queue import EXPORTS, JOBS, MAKE_EXPORT, RUN_JOB, enqueue, queue_client
from specimap_infra.schema_version import known_revisions
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import TEMPORARY, Storage
from specimap_infra.tables import FINAL_STATES, PRIORITIES, Base, Export, Job, Upload


def check_backup(
    source: Path, *, progress: Progress = lambda *_: None, cancelled: Cancelled = lambda: False
) -> Manifest:
    """Check every checksum of a backup.

    Raises:
        BackupInvalidError: a part is missing or differs, or this program does not know its schema.
        CancelledError: ``cancelled`` came true.
    """
    manifest, entries = _read(source)
    past = 0
    for entry in entries:
        if cancelled():
            raise CancelledError("The check was stopped.", advice="Give the command again.")
        if digest_of(source / FILES / entry.key) != entry.sha256:
            raise changed(entry.key)
        past += entry.size
        progress("check", past / max(manifest.bytes, 1))
    return manifest


def restore_backup(
    settings: ServiceSettings,
    source: Path,
    *,
    progress: Progress = lambda *_: None,
    cancelled: Cancelled = lambda: False,
) -> Manifest:
    """Restore into the database and the storage that the settings name; both hold nothing else.

    The files come first, each whole and checked; then the rows, all at once. A restore that was stopped is continued by
    the same call. Jobs that had not ended are queued again, without a worker; unfinished uploads count as expired.

    Raises:
        BackupInvalidError: a part of the backup is missing or differs, or this program does not know its schema.
        RestoreTargetError: the database or the storage holds something.
        CancelledError: ``cancelled`` came true; the database is as it was.
        DatabaseTooNewError, DatabaseUnavailableError, StorageUnavailableError, StorageFullError.
    """
    manifest, entries = _read(source)
    refuse_used_database(settings.database)
    storage = Storage.open(settings)
    present = refuse_used_storage(storage, entries)
    _restore_files(storage, settings, source, entries, present, progress, cancelled)
    progress("rows", 0.0)
    _restore_rows(settings.database, source / ROWS, manifest)
    progress("rows", 1.0)
    return manifest


def _read(source: Path) -> tuple[Manifest, list[Entry]]:
    manifest = read_manifest(source)
    if manifest.revision not in known_revisions():
        raise BackupInvalidError(
            f"The backup was made by release {manifest.program}, whose schema this one does not know.",
            advice=f"Restore it with release {manifest.program} or a later one.",
            program=manifest.program,
        )
    if digest_of(source / ROWS) != manifest.rows_sha256:
        raise changed(ROWS)
    return manifest, read_entries(source, manifest)


# ---- files --------------------------------------------------------------------------------------------


def _restore_files(
    storage: Storage,
    settings: ServiceSettings,
    source: Path,
    entries: Sequence[Entry],
    present: set[str],
    progress: Progress,
    cancelled: Cancelled,
) -> None:
    past, total = 0, sum(entry.size for entry in entries)
    for entry in entries:
        if cancelled():
            raise CancelledError("The restore was stopped.", advice="Give the same command again to continue.")
        if (
            entry.key not in present
            or storage.stat(entry.key).size != entry.size
            or _digest(storage.stream(entry.key)) != entry.sha256
        ):
            restore_file(storage, settings, source, entry, cancelled)
        past += entry.size
        progress("files", past / max(total, 1))


def restore_file(
    storage: Storage, settings: ServiceSettings, source: Path, entry: Entry, cancelled: Cancelled = lambda: False
) -> None:
    """Store a file of a backup, whole and checked.

    Raises:
        BackupInvalidError: the file is missing or differs from what was saved.
        CancelledError: ``cancelled`` came true.
        StorageUnavailableError, StorageFullError.
    """
    # On the storage's own disk, where a rename is enough.
    folder = settings.scratch if storage.folder is None else storage.folder / TEMPORARY
    aside = folder / f"restore-{uuid.uuid4().hex}.tmp"
    try:
        with disk_errors(aside), _as_saved(entry, source):
            size, digest = hashed(pieces_of(source / FILES / entry.key), aside, cancelled)
        if (size, digest) != (entry.size, entry.sha256):
            raise changed(entry.key)
        storage.put_file(entry.key, aside)
    finally:
        remove(aside)


@contextmanager
def _as_saved(entry: Entry, source: Path) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        if (source / FILES / entry.key).exists():
            raise
        raise changed(entry.key) from error


def _digest(pieces: Iterator[bytes]) -> str:
    digest = hashlib.sha256()
    for piece in pieces:
        digest.update(piece)
    return digest.hexdigest()


# ---- rows ---------------------------------------------------------------------------------------------


def _restore_rows(url: str, rows: Path, manifest: Manifest) -> None:
    file = sqlite_file(url)
    if file is None:
        database = Database.open(url)
        try:
            # Programs that start meanwhile wait for the tables.
            with database_errors(), exclusive_lock(database.engine):
                refuse_rows(database.engine)
                _fill(database, rows, manifest)
        finally:
            database.close()
        return
    with _sqlite_aside(file) as aside:
        database = Database.open(f"sqlite:///{aside}")
        try:
            _fill(database, rows, manifest)
            with database.engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        finally:
            database.close()


@contextmanager
def _sqlite_aside(file: Path) -> Iterator[Path]:
    """Make a database next to ``file``, and rename it into place when the block succeeds."""
    aside = file.with_name(f".{file.name}.{uuid.uuid4().hex[:8]}.tmp")
    target = Database.open(f"sqlite:///{file}")
    try:
        with disk_errors(file), exclusive_lock(target.engine):
            # A service may have been started on the empty database since it was looked at.
            refuse_rows(target.engine)
            target.close()
            yield aside
            with open(aside, "rb") as written:
                os.fsync(written.fileno())
            for ending in JOURNALS:
                file.with_name(file.name + ending).unlink(missing_ok=True)
            os.replace(aside, file)
    finally:
        target.close()
        for path in (aside, aside.with_suffix(".lock"), *(aside.with_name(aside.name + end) for end in JOURNALS)):
            remove(path)


def _fill(database: Database, rows: Path, manifest: Manifest) -> None:
    """Make the tables, fill them and queue what had not ended, all in one transaction."""
    engine = database.engine
    DBOS.migrate(engine.url.render_as_string(hide_password=False))
    client = queue_client(engine)
    with engine.connect() as connection, unhurried(connection), whole(connection):
        # They hold nothing, and may be newer than the backup.
        Base.metadata.drop_all(connection)
        connection.exec_driver_sql("DROP TABLE IF EXISTS alembic_version")
        command.upgrade(alembic_config(connection), manifest.revision)
        load_rows(connection, rows, frozenset(manifest.missing))
        command.upgrade(alembic_config(connection), "head")
        with Session(connection, expire_on_commit=False) as session:
            for job in session.scalars(
                sa.select(Job).where(Job.state.not_in(FINAL_STATES)).order_by(Job.created_at, Job.id)
            ).all():
                if job.state == "running":
                    jobs.set_state(session, job.id, "queued")
                # What stopped it was not the job.
                job.starts, job.setbacks = 0, {}
                enqueue(client, session, JOBS, RUN_JOB, job.id, job.priority)
            unmade = sa.select(Export).where(Export.state.not_in(FINAL_STATES)).order_by(Export.created_at, Export.id)
            for export in session.scalars(unmade).all():
                export.state, export.executor, export.setbacks = "queued", None, {}
                enqueue(client, session, EXPORTS, MAKE_EXPORT, export.id, PRIORITIES["routine"])
            # Their bytes were in the scratch folder of the machine that was saved.
            session.execute(sa.update(Upload).where(Upload.state == "open").values(state="expired"))
            session.flush()
