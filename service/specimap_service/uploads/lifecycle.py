"""Resumable uploads: created, finished, terminated, expired."""

from __future__ import annotations

import datetime
import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import sqlalchemy as sa
from fastapi.concurrency import run_in_threadpool
from sqlalchemy.orm import Session
from starlette.types import Receive

from specimap_core.errors import NotFoundError
from specimap_infra.database import rows_changed, utc_now
from specimap_infra.errors import JobConflictError
from specimap_infra.ids import new_id
from specimap_infra.tables import ROLES, Acquisition, StoredFile, Upload
from specimap_service.acquisitions.capacity import check_count, check_size, locked_acquisition
from specimap_service.acquisitions.inspection import Arrival
from specimap_service.acquisitions.intake import clean_name, take_in
from specimap_service.acquisitions.judge import Judge
from specimap_service.acquisitions.schemas import counts
from specimap_service.auth.access import load, no_upload
from specimap_service.auth.keys import Principal
from specimap_service.context import AppContext, audit
from specimap_service.errors import ForbiddenError, RequestInvalidError, UploadGoneError
from specimap_service.fair_turns import FairTurns
from specimap_service.idempotency import Repeatable
from specimap_service.space import check_disks, check_quota
from specimap_service.uploads.files import UploadBytes, check_id, locked

FINISH_SECONDS = 60.0
"""How long one process waits for another that finishes the same upload, in addition to the time of the judging."""
SERVICE = "service"
"""Stands for the key in the audit trail where the service acted by itself."""


@dataclass(frozen=True)
class Uploads:
    """The uploads of the app, their rows and their bytes. All but the coroutines block: call these from a thread."""

    context: AppContext
    files: UploadBytes
    judge: Judge
    intake: FairTurns

    def create(
        self,
        principal: Principal,
        metadata: Mapping[str, str],
        size: int | None,
        idempotency_key: str | None = None,
    ) -> Upload:
        """Create an upload after checking that its file fits, or return the one that the same request created.

        Raises:
            RequestInvalidError: the metadata or the length are missing or wrong.
            NotFoundError, JobConflictError: there is no such acquisition; it has this file already.
            PayloadTooLargeError, QuotaExceededError, StorageFullError: it does not fit.
            IdempotencyConflictError: the idempotency key belongs to another request.
        """
        role, acquisition_id = metadata.get("role", ""), metadata.get("acquisition", "")
        if role not in ROLES:
            raise RequestInvalidError(
                "Upload-Metadata names no role.", advice=f"Give `role`: one of {', '.join(ROLES)}.", field="role"
            )
        if not re.fullmatch(r"acq_[0-9a-z]{26}", acquisition_id):
            raise RequestInvalidError(
                "Upload-Metadata names no acquisition.", advice="Give `acquisition`: its id.", field="acquisition"
            )
        if size is None or size < 1:
            raise RequestInvalidError(
                "Upload-Length is missing or not positive.",
                advice="Give the file's size in bytes.",
                field="Upload-Length",
            )
        check_size(self.context.settings, role, size)
        now = utc_now()
        upload = Upload(
            id=new_id("up"),
            acquisition_id=acquisition_id,
            role=role,
            name=clean_name(metadata.get("filename", "")),
            size=size,
            state="open",
            created_at=now,
            created_by=principal.key_id,
            expires_at=now + datetime.timedelta(hours=self.context.settings.upload_hours),
        )

        def make(session: Session, _: str) -> tuple[str, Upload]:
            load(session, principal, Acquisition, acquisition_id)
            locked_acquisition(session, acquisition_id)
            if role == "photo":
                check_count(session, self.context.settings, acquisition_id, 1)
            else:
                _check_wanted(session, acquisition_id, role)
            check_quota(session, principal, size)
            check_disks(self.context, size, self.files.coming(session))
            session.add(upload)
            details = {"acquisition": acquisition_id, "role": role, "size": size}
            audit(session, principal.key_id, "upload.create", upload.id, **details)
            return upload.id, upload

        def again(session: Session, upload_id: str, _: str) -> Upload:
            return load(session, principal, Upload, upload_id)

        given = {"acquisition": acquisition_id, "role": role, "name": upload.name, "size": size}
        request = Repeatable.of(principal, idempotency_key, "uploads.create", given)
        self.files.create(upload.id)
        try:
            found, new = request.once(self.context.database, make, again)
        except BaseException:
            self.files.remove(upload.id)
            raise
        if not new:
            self.files.remove(upload.id)
        return found

    async def current(self, upload_id: str, principal: Principal, receive: Receive | None = None) -> Upload:
        """Return the upload as it stands; finish one whose last byte arrived in a process that died.

        ``receive``: of a request without a body, as of :meth:`finish_in_turn`.

        Raises:
            NotFoundError: there is none in the key's project.
            ForbiddenError: another key of the project created it.
            UploadGoneError: it expired or was ended.
            TooManyAtOnceError, OverloadedError: it is whole, and too many files wait to be judged.
        """
        upload, whole = await run_in_threadpool(self._current, upload_id, principal)
        return await self.finish_in_turn(upload, receive) if whole else upload

    async def finish_in_turn(self, upload: Upload, receive: Receive | None = None) -> Upload:
        """Finish an upload that has arrived whole, as :meth:`finish` does, in a turn of its key.

        ``receive``: of the request, when its body has been read. Where its client goes away before the turn has come,
        the file is not judged; the bytes are kept, and the next request tries again.

        Raises TooManyAtOnceError and OverloadedError besides, and ClientDisconnect: the bytes are kept too.
        """
        work = partial(self.finish, upload.id)
        if receive is None:
            return await self.intake.run(upload.created_by, work)
        return await self.intake.run_while(receive, upload.created_by, work)

    def _current(self, upload_id: str, principal: Principal) -> tuple[Upload, bool]:
        check_id(upload_id)
        with self.context.database.session() as session:
            upload = load(session, principal, Upload, upload_id)
        if upload.created_by != principal.key_id and not principal.is_admin:
            raise ForbiddenError(
                "Another key created this upload.", advice="Use that key, or one with the scope admin."
            )
        if upload.state == "open" and self.files.size(upload_id) == upload.size:
            return upload, True
        if upload.state == "open" and upload.expires_at <= utc_now():
            self.expire(upload_id)
            upload.state = "expired"
        return upload, False

    def renewed(self, upload: Upload) -> Upload:
        """Return the upload as it stands now, where another request has finished or ended it since it was read."""
        if upload.state == "open" and self.files.size(upload.id) is None:
            return self._row(upload.id)
        return upload

    def finish(self, upload_id: str) -> Upload:
        """Judge and store a file that has arrived whole, once only, even if two processes try or one crashed.

        Raises:
            NotFoundError, UploadLockedError: there is none, or another request holds it.
            StorageUnavailableError, StorageFullError, BackendUnavailableError: the next request tries again; the bytes
                are kept.
        """
        try:
            with locked(self.files, upload_id, self.context.settings.judge_seconds + FINISH_SECONDS):
                upload = self._row(upload_id)
                if upload.state == "open" and self.files.size(upload_id) == upload.size:
                    self._finish(upload)
        except NotFoundError:
            # Another process has finished it, and its file is in the storage.
            pass
        return self._row(upload_id)

    def _finish(self, upload: Upload) -> None:
        # The same id at every attempt: the file of an attempt that died is overwritten.
        file_id = f"file_{upload.id.removeprefix('up_')}"
        with self.files.whole(upload.id) as path:
            with open(path, "rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            try:
                take_in(
                    self.context,
                    self.judge,
                    Arrival(
                        file_id,
                        upload.acquisition_id,
                        upload.role,
                        upload.name,
                        path,
                        upload.size,
                        digest,
                        upload.created_by,
                        upload_id=upload.id,
                    ),
                )
            except JobConflictError as error:
                with self.context.database.session() as session:
                    row = session.get_one(Upload, upload.id)
                    row.state, row.error = "failed", error.as_dict()
        self.files.remove(upload.id)

    def terminate(self, upload_id: str, principal: Principal) -> None:
        """End an upload and remove its bytes; the caller holds its lock. Raises JobConflictError for a finished one."""
        with self.context.database.session() as session:
            changed = session.execute(
                sa.update(Upload).where(Upload.id == upload_id, Upload.state == "open").values(state="terminated")
            )
            if not rows_changed(changed):
                raise JobConflictError(
                    "The upload is finished; its file is stored.", advice="Delete the file of the acquisition instead."
                )
            audit(session, principal.key_id, "upload.terminate", upload_id)
        self.files.remove(upload_id)

    def expire(self, upload_id: str) -> None:
        """Mark an open upload as expired and remove its bytes."""
        with self.context.database.session() as session:
            changed = session.execute(
                sa.update(Upload).where(Upload.id == upload_id, Upload.state == "open").values(state="expired")
            )
            if rows_changed(changed):
                audit(session, SERVICE, "upload.expire", upload_id)
        self.files.remove(upload_id)

    def stored_file(self, upload: Upload) -> StoredFile | None:
        """Return the file that an upload became; None before, and after its deletion."""
        if upload.file_id is None:
            return None
        with self.context.database.session() as session:
            return session.get(StoredFile, upload.file_id)

    def _row(self, upload_id: str) -> Upload:
        with self.context.database.session() as session:
            upload = session.get(Upload, upload_id)
        if upload is None:
            raise no_upload()
        return upload


def check_alive(upload: Upload) -> None:
    """Raise UploadGoneError for an upload that expired or was ended."""
    if upload.state in ("expired", "terminated"):
        raise UploadGoneError(
            f"The upload is {upload.state}.", advice="Create another one with POST /v1/uploads.", state=upload.state
        )


def _check_wanted(session: Session, acquisition_id: str, role: str) -> None:
    rows = session.scalars(sa.select(StoredFile).where(StoredFile.acquisition_id == acquisition_id)).all()
    if getattr(counts(rows), role):
        raise JobConflictError(
            f"The acquisition has a {'cube' if role == 'cube' else role + ' reference'} already.",
            advice="Delete its files first, then upload another.",
        )
