"""Deletion of acquisitions with all that belongs to them: rows first, in one transaction, then files.

Whoever deletes asks :func:`check_removable` in that transaction.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import sqlalchemy as sa
from dbos import DBOSClient
from sqlalchemy.orm import Session

from specimap_core.atomic import remove
from specimap_core.errors import NotFoundError
from specimap_infra.errors import JobConflictError, LegalHoldError
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    FINAL_STATES,
    Acquisition,
    Artefact,
    CloudRow,
    Delivery,
    DicomInstance,
    DicomSet,
    Export,
    FhirNotice,
    Job,
    JobEvent,
    LabelVersion,
    LegalHold,
    ReceivedStudy,
    RepeatableRequest,
    SealedStudy,
    Share,
    SignIn,
    StoredFile,
    Upload,
    UploadPart,
)


@dataclass(frozen=True)
class Removal:
    """What goes with acquisitions: ids of workflows, prefixes in the storage, names in scratch folders, counts of
    rows."""

    workflows: tuple[str, ...]
    prefixes: tuple[str, ...]
    names: tuple[str, ...]
    rows: dict[str, int]

    def stored(self) -> dict[str, Any]:
        """Return it as JSON."""
        return asdict(self)

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Self:
        """Read it from JSON."""
        lists = {name: tuple(stored[name]) for name in ("workflows", "prefixes", "names")}
        return cls(**lists, rows=dict(stored["rows"]))


def check_not_held(session: Session, acquisition_id: str) -> None:
    """Raise LegalHoldError where a hold keeps an acquisition."""
    found = session.get(LegalHold, acquisition_id)
    if found is not None:
        raise LegalHoldError(
            f"A legal hold ({found.reason}) keeps {acquisition_id}: nothing of it is deleted.",
            advice="An administrator may release the hold: DELETE its address.",
            acquisition_id=acquisition_id,
            reason=found.reason,
        )


def check_removable(session: Session, acquisition_id: str) -> None:
    """Raise LegalHoldError where a hold keeps the acquisition, JobConflictError where a job works on it."""
    check_not_held(session, acquisition_id)
    busy = session.scalar(
        sa.select(Job.id).where(Job.acquisition_id == acquisition_id, Job.state.not_in(FINAL_STATES)).limit(1)
    )
    if busy is not None:
        raise JobConflictError(
            f"Job {busy} works on the acquisition.", advice="Wait for it, or cancel it first.", job_id=busy
        )


def remove_rows(session: Session, acquisitions: Sequence[str]) -> Removal:
    """Delete all rows that belong to acquisitions, sessions of shares and names of requests too; return what is left
    to remove."""

    def ids(query: sa.Select[str]) -> list[str]:
        return list(session.scalars(query))

    jobs = ids(sa.select(Job.id).where(Job.acquisition_id.in_(acquisitions)))
    clouds = ids(sa.select(CloudRow.id).where(CloudRow.acquisition_id.in_(acquisitions)))
    exports = ids(sa.select(Export.id).where(Export.cloud_id.in_(clouds)))
    shares = ids(sa.select(Share.id).where(Share.cloud_id.in_(clouds)))
    uploads = ids(sa.select(Upload.id).where(Upload.acquisition_id.in_(acquisitions)))
    parts = ids(sa.select(UploadPart.storage_key).where(UploadPart.upload_id.in_(uploads)))
    every = [*acquisitions, *jobs, *clouds, *exports, *shares, *uploads]
    conditions: dict[type[Any], sa.ColumnElement[bool]] = {
        SignIn: SignIn.share_id.in_(shares),
        RepeatableRequest: RepeatableRequest.object_id.in_(every),
        Delivery: Delivery.job_id.in_(jobs),
        JobEvent: JobEvent.job_id.in_(jobs),
        LabelVersion: LabelVersion.cloud_id.in_(clouds),
        Share: Share.id.in_(shares),
        Export: Export.id.in_(exports),
        DicomInstance: DicomInstance.set_id.in_(sa.select(DicomSet.id).where(DicomSet.cloud_id.in_(clouds))),
        DicomSet: DicomSet.cloud_id.in_(clouds),
        FhirNotice: FhirNotice.cloud_id.in_(clouds),
        SealedStudy: SealedStudy.acquisition_id.in_(acquisitions),
        ReceivedStudy: ReceivedStudy.acquisition_id.in_(acquisitions),
        CloudRow: CloudRow.id.in_(clouds),
        Artefact: Artefact.acquisition_id.in_(acquisitions),
        Job: Job.id.in_(jobs),
        UploadPart: UploadPart.upload_id.in_(uploads),
        Upload: Upload.id.in_(uploads),
        StoredFile: StoredFile.acquisition_id.in_(acquisitions),
        Acquisition: Acquisition.id.in_(acquisitions),
    }
    rows = {}
    for table, condition in conditions.items():
        count = session.scalar(sa.select(sa.func.count()).select_from(table).where(condition)) or 0
        session.execute(sa.delete(table).where(condition), execution_options={"synchronize_session": False})
        rows[table.__tablename__] = count
    places = {"acquisitions": acquisitions, "jobs": jobs, "clouds": clouds, "exports": exports}
    prefixes = [f"{place}/{name}" for place, names in places.items() for name in names]
    return Removal((*jobs, *exports), (*prefixes, *parts), tuple(every), rows)


def remove_rest(removal: Removal, queue: DBOSClient, storage: Storage, folders: Iterable[Path]) -> int:
    """Remove what the job engine knows, stored files, and what lies in ``folders`` under names with their ids; return
    how many stored files there were. Safe to repeat.

    Raises:
        StorageUnavailableError, DatabaseUnavailableError: something may be left.
    """
    if removal.workflows:
        queue.delete_workflows(list(removal.workflows))
    files = 0
    for prefix in removal.prefixes:
        files += stored_files(storage, prefix)
        storage.delete(prefix)
    for path in leftovers(removal, folders):
        remove(path)
    return files


def stored_files(storage: Storage, prefix: str) -> int:
    """Count the files at or below a prefix."""
    local = storage.path(prefix)
    if local is not None:
        return 1 if local.is_file() else sum(path.is_file() for path in local.rglob("*")) if local.is_dir() else 0
    try:
        return sum(1 for _ in storage.list(prefix))
    except NotFoundError:
        return 0


def leftovers(removal: Removal, folders: Iterable[Path]) -> list[Path]:
    """List what lies in folders under a name with one of the ids."""
    found = []
    for top in folders:
        for folder, names, files in os.walk(top):
            mine = [name for name in (*names, *files) if any(id in name for id in removal.names)]
            found += [Path(folder, name) for name in mine]
            names[:] = [name for name in names if name not in mine]
    return found
