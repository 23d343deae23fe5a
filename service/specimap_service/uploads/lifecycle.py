"""The life of a resumable upload: created, finished, ended, expired. All of it blocks: call it from a thread."""

from __future__ import annotations

import datetime
import hashlib
import os
import shutil
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import NotFoundError, SpecimapError
from specimap_infra.database import utc_now
from specimap_infra.errors import JobConflictError
from specimap_infra.ids import new_id
from specimap_infra.logs import logger
from specimap_infra.tables import ROLES, StoredFile, Upload
from specimap_service.acquisitions.capacity import check_count, check_disks, check_quota, check_size, locked_acquisition
from specimap_service.acquisitions.inspection import Arrival
from specimap_service.acquisitions.intake import shown_name, take_in
from specimap_service.acquisitions.schemas import counts
from specimap_service.auth.keys import Principal
from specimap_service.context import AppContext, audit
from specimap_service.errors import ForbiddenError, RequestInvalidError, UploadGoneError
from specimap_service.uploads.files import UploadFiles, no_upload

STRAY_SECONDS = 3600.0
FINISH_SECONDS = 60.0
"""How long one process waits for another that is finishing the same upload, over the time of the judging."""
SERVICE = "service"
"""Who did what no key did, in the audit trail."""


def create(
    context: AppContext, files: UploadFiles, principal: Principal, metadata: Mapping[str, str], size: int | None
) -> Upload:
    """Make room for a file and an upload for it.

    Raises:
        RequestInvalidError: the metadata or the length are missing or wrong.
        NotFoundError, JobConflictError: there is no such acquisition; it has this file already.
        PayloadTooLargeError, QuotaExceededError, StorageFullError: it does not fit.
    """
    role, acquisition_id = metadata.get("role", ""), metadata.get("acquisition", "")
    if role not in ROLES:
        raise RequestInvalidError(
            "Upload-Metadata names no role.", advice=f"Give `role`: one of {', '.join(ROLES)}.", field="role"
        )
    if not acquisition_id:
        raise RequestInvalidError(
            "Upload-Metadata names no acquisition.", advice="Give `acquisition`: its id.", field="acquisition"
        )
    if size is None or size < 1:
        raise RequestInvalidError(
            "Upload-Length is missing or not positive.", advice="Give the file's size in bytes.", field="Upload-Length"
        )
    check_size(context.settings, role, size)
    now = utc_now()
    upload = Upload(
        id=new_id("up"),
        acquisition_id=acquisition_id,
        role=role,
        name=shown_name(metadata.get("filename", "")),
        size=size,
        state="open",
        created_at=now,
        created_by=principal.key_id,
        expires_at=now + datetime.timedelta(hours=context.settings.upload_hours),
    )
    files.create(upload.id)
    try:
        with context.database.session() as session:
            locked_acquisition(session, acquisition_id)
            if role == "photo":
                check_count(session, context.settings, acquisition_id, 1)
            else:
                _check_wanted(session, acquisition_id, role)
            check_quota(session, principal, size)
            check_disks(context, size, _coming(session, files))
            session.add(upload)
            audit(
                session, principal.key_id, "upload.create", upload.id, acquisition=acquisition_id, role=role, size=size
            )
    except BaseException:
        files.remove(upload.id)
        raise
    return upload


def _check_wanted(session: Session, acquisition_id: str, role: str) -> None:
    rows = session.scalars(sa.select(StoredFile).where(StoredFile.acquisition_id == acquisition_id)).all()
    if getattr(counts(rows), role):
        raise JobConflictError(
            f"The acquisition has a {'cube' if role == 'cube' else role + ' reference'} already.",
            advice="Delete its files first, then upload another.",
        )


def _coming(session: Session, files: UploadFiles) -> int:
    """Bytes that open uploads will still bring."""
    rows = session.execute(
        sa.select(Upload.id, Upload.size).where(Upload.state == "open", Upload.expires_at > utc_now())
    )
    return sum(max(0, size - (files.size(upload_id) or 0)) for upload_id, size in rows)


def current(context: AppContext, files: UploadFiles, upload_id: str, principal: Principal) -> Upload:
    """The upload as it stands; one whose last byte arrived in a process that died is finished now.

    Raises:
        NotFoundError: there is none.
        ForbiddenError: another key created it.
        UploadGoneError: it expired or was ended.
    """
    files.path(upload_id)
    with context.database.session() as session:
        upload = session.get(Upload, upload_id)
    if upload is None:
        raise no_upload()
    if upload.created_by != principal.key_id and "admin" not in principal.scopes:
        raise ForbiddenError("Another key created this upload.", advice="Use that key, or one with the scope admin.")
    if upload.state == "open" and files.size(upload_id) == upload.size:
        return finish(context, files, upload_id)
    if upload.state == "open" and upload.expires_at <= utc_now():
        expire(context, files, upload_id)
        upload.state = "expired"
    return upload


def check_alive(upload: Upload) -> None:
    """Raise UploadGoneError for an upload that expired or was ended."""
    if upload.state in ("expired", "terminated"):
        raise UploadGoneError(
            f"The upload is {upload.state}.", advice="Create another one with POST /v1/uploads.", state=upload.state
        )


def finish(context: AppContext, files: UploadFiles, upload_id: str) -> Upload:
    """Judge and store a file that has arrived whole. Done twice, by two processes or after a crash, it is done once.

    Raises:
        NotFoundError, UploadLockedError; StorageUnavailableError, StorageFullError, BackendUnavailableError: the bytes
            are kept; the next request tries again.
    """
    try:
        with files.locked(upload_id, context.settings.judge_seconds + FINISH_SECONDS):
            upload = _row(context, upload_id)
            if upload.state == "open" and files.size(upload_id) == upload.size:
                _finish(context, files, upload)
    except NotFoundError:
        # Another process has finished it, and its file is in the storage.
        pass
    return _row(context, upload_id)


def _row(context: AppContext, upload_id: str) -> Upload:
    with context.database.session() as session:
        upload = session.get(Upload, upload_id)
    if upload is None:
        raise no_upload()
    return upload


def _finish(context: AppContext, files: UploadFiles, upload: Upload) -> None:
    path = files.path(upload.id)
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    # A second name is stored and the first removed only after the commit: whatever happens between, all is still there.
    aside = path.with_suffix(".whole")
    with disk_errors(aside):
        aside.unlink(missing_ok=True)
        os.link(path, aside)
    # The same id at every attempt: one that died after storing is overwritten, not left behind.
    file_id = f"file_{upload.id.removeprefix('up_')}"
    try:
        take_in(
            context,
            Arrival(
                file_id,
                upload.acquisition_id,
                upload.role,
                upload.name,
                aside,
                upload.size,
                digest,
                upload.created_by,
                upload_id=upload.id,
            ),
        )
    except JobConflictError as error:
        with context.database.session() as session:
            row = session.get_one(Upload, upload.id)
            row.state, row.error = "failed", error.as_dict()
    finally:
        remove(aside)
    files.remove(upload.id)


def terminate(context: AppContext, files: UploadFiles, upload_id: str, principal: Principal) -> None:
    """End an upload and forget its bytes; the caller holds its lock. Raises JobConflictError for a finished one."""
    with context.database.session() as session:
        changed = session.execute(
            sa.update(Upload).where(Upload.id == upload_id, Upload.state == "open").values(state="terminated")
        )
        if not changed.rowcount:  # type: ignore[attr-defined]
            raise JobConflictError(
                "The upload is finished; its file is stored.", advice="Delete the file of the acquisition instead."
            )
        audit(session, principal.key_id, "upload.terminate", upload_id)
    files.remove(upload_id)


def expire(context: AppContext, files: UploadFiles, upload_id: str) -> None:
    """Mark an open upload as expired and forget its bytes."""
    with context.database.session() as session:
        changed = session.execute(
            sa.update(Upload).where(Upload.id == upload_id, Upload.state == "open").values(state="expired")
        )
        if changed.rowcount:  # type: ignore[attr-defined]
            audit(session, SERVICE, "upload.expire", upload_id)
    files.remove(upload_id)


def sweep(context: AppContext, files: UploadFiles) -> None:
    """Expire what is due, and remove what killed processes left. Several processes may do so at once."""
    with context.database.session() as session:
        rows = session.execute(sa.select(Upload.id, Upload.size, Upload.expires_at).where(Upload.state == "open")).all()
    due = [row for row in rows if row.expires_at <= utc_now()]
    for row in due:
        if files.size(row.id) == row.size:
            # Whole, but its process died: nobody needs to ask for it.
            with suppress(SpecimapError):
                finish(context, files, row.id)
            continue
        with suppress(NotFoundError):
            handle = files.try_lock(row.id)
            if handle is None:  # being written to: left to its writer
                continue
            os.close(handle)
        expire(context, files, row.id)
    known = {row.id for row in rows}
    for path in files.strays(known, STRAY_SECONDS):
        remove(path)
    judging = context.settings.scratch / "judging"
    for folder in judging.iterdir() if judging.is_dir() else ():
        _remove_old(folder)
    if due:
        logger().info("uploads swept", expired=len(due))


def _remove_old(folder: Path) -> None:
    with suppress(FileNotFoundError):
        if time.time() - folder.stat().st_mtime > STRAY_SECONDS:
            shutil.rmtree(folder, ignore_errors=True)
