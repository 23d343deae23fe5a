"""Judge and store a file that has arrived whole, by whichever way it was uploaded."""

from __future__ import annotations

import os
import re
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors
from specimap_core.errors import NotFoundError
from specimap_infra.errors import DatabaseUnavailableError, JobConflictError
from specimap_infra.tables import Acquisition, StoredFile, Upload
from specimap_service.acquisitions.capacity import check_count, locked_acquisition
from specimap_service.acquisitions.inspection import Arrival, Findings, Known, judged
from specimap_service.acquisitions.judge import Judge
from specimap_service.auth.access import not_found
from specimap_service.context import AppContext, audit
from specimap_service.space import check_quota

ATTEMPTS = 5
"""The other part of a cube may arrive or be deleted while one is judged; it is then judged again."""
LONGEST_NAME = 255


def clean_name(name: str) -> str:
    """Return a client's file name without control characters, and not too long to be stored and shown."""
    return re.sub(r"[\x00-\x1f\x7f\ud800-\udfff]", "", name)[:LONGEST_NAME]


def take_in(context: AppContext, judge: Judge, arrival: Arrival) -> StoredFile:
    """Judge and store a file; a refused one is stored too, to be shown.

    Raises:
        NotFoundError: the acquisition is gone.
        JobConflictError: the cube has this part already.
        QuotaExceededError, StorageFullError, StorageUnavailableError, BackendUnavailableError: try again later.
    """
    key = f"acquisitions/{arrival.acquisition_id}/{arrival.file_id}"
    stored_already = False
    try:
        for _ in range(ATTEMPTS):
            known = _known(context, arrival.acquisition_id)
            with _judging_folder(context) as folder:
                if stored_already:
                    context.storage.fetch(key, folder / "file")
                else:
                    with disk_errors(folder):
                        os.link(arrival.path, folder / "file")
                try:
                    findings = judged(judge, context.storage, arrival, known, folder)
                except NotFoundError:  # the other part was deleted meanwhile
                    continue
            if not stored_already:
                stored_already = True
                context.storage.put_file(key, arrival.path)
            stored = _add_row(context, arrival, known, findings, key)
            if stored is not None:
                context.metrics.judged.labels(findings.own.verdict).inc()
                return stored
    except DatabaseUnavailableError:
        # The commit may have succeeded all the same: the file that its row names must stay.
        raise
    except BaseException:
        if stored_already:
            context.storage.delete(key)
        raise
    context.storage.delete(key)
    raise JobConflictError(
        "The acquisition's files changed again and again meanwhile.", advice="Upload one part of a cube at a time."
    )


def _known(context: AppContext, acquisition_id: str) -> Known:
    with context.database.session() as session:
        acquisition = session.get(Acquisition, acquisition_id)
        if acquisition is None:
            raise not_found(acquisition_id)
        return Known(acquisition.dictionary, _files(session, acquisition_id))


def _files(session: Session, acquisition_id: str) -> tuple[StoredFile, ...]:
    return tuple(session.scalars(sa.select(StoredFile).where(StoredFile.acquisition_id == acquisition_id)))


@contextmanager
def _judging_folder(context: AppContext) -> Iterator[Path]:
    """Make a folder for one file, to be judged under a name that the program chose."""
    folder = context.settings.scratch / "judging" / uuid.uuid4().hex
    with disk_errors(folder):
        folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


# ---- writing ------------------------------------------------------------------------------------------


def _add_row(context: AppContext, arrival: Arrival, known: Known, findings: Findings, key: str) -> StoredFile | None:
    """Add the row of the stored file; None where files that the judgement depends on have changed meanwhile."""
    with context.database.session() as session:
        locked_acquisition(session, arrival.acquisition_id)
        files = _files(session, arrival.acquisition_id)
        if _relevant_ids(arrival, files) != _relevant_ids(arrival, known.files):
            return None
        if arrival.principal is not None:
            check_quota(session, arrival.principal, arrival.size)
            if arrival.role == "photo":
                check_count(session, context.settings, arrival.acquisition_id, 1)
        labels = {file.label for file in files}
        if findings.other is not None:
            row, judgement = findings.other
            current = session.get_one(StoredFile, row.id)
            current.judgement = judgement.model_dump(mode="json")
            if judgement.verdict == "refused":
                current.state = "refused"
                labels.discard(current.label)
                current.label = _label(current.role, PurePosixPath(current.label).suffix, "refused", labels)
                labels.add(current.label)
                # Its old label must be free before the new file can have it.
                session.flush()
        state = "refused" if findings.own.verdict == "refused" else "accepted"
        stored = StoredFile(
            id=arrival.file_id,
            acquisition_id=arrival.acquisition_id,
            role=arrival.role,
            name=arrival.name,
            label=_label(arrival.role, findings.suffix, state, labels),
            size=arrival.size,
            sha256=arrival.sha256,
            storage_key=key,
            state=state,
            judgement=findings.own.model_dump(mode="json"),
            created_by=arrival.key_id,
        )
        session.add(stored)
        if arrival.upload_id is not None:
            upload = session.get_one(Upload, arrival.upload_id)
            upload.state, upload.file_id = "finished", arrival.file_id
        audit(
            session,
            arrival.key_id,
            "file.create",
            arrival.file_id,
            acquisition=arrival.acquisition_id,
            role=arrival.role,
            state=state,
            size=arrival.size,
        )
    return stored


def _relevant_ids(arrival: Arrival, files: tuple[StoredFile, ...]) -> set[str]:
    if arrival.role == "photo":
        return {f.id for f in files if f.sha256 == arrival.sha256 and f.state == "accepted"}
    return {f.id for f in files if f.role != "photo" and f.state == "accepted"}


def _label(role: str, suffix: str, state: str, labels: set[str]) -> str:
    if role != "photo" and state == "accepted":
        return f"{role}{suffix}"
    stem = "photo" if role == "photo" else f"refused-{role}"
    numbers = [int(found[1]) for label in labels if (found := re.match(rf"{stem}-(\d+)\.", label))]
    return f"{stem}-{max(numbers, default=0) + 1:04d}{suffix}"


def forget_part(session: Session, file: StoredFile) -> None:
    """Let the other part of a cube wait for this one again, which is being deleted."""
    if file.role == "photo" or file.state != "accepted" or file.judgement["part"] == "whole":
        return
    for other in _files(session, file.acquisition_id):
        if other.role == file.role and other.state == "accepted" and other.id != file.id:
            other.judgement = {**other.judgement, "waiting_for": file.judgement["part"]}
