"""Files of an acquisition: sent in a form, listed with their judgement, read, deleted."""

from __future__ import annotations

import asyncio
from pathlib import PurePosixPath
from typing import Any

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from sqlalchemy.orm import Session

from specimap.core.errors import NotFoundError
from specimap.core.photoformats import MEDIA_TYPES
from specimap.infra.errors import QuotaExceededError, RequestInvalidError
from specimap.infra.ids import new_id
from specimap.infra.models import Acquisition, StoredFile
from specimap.service.auth import Principal, Reader, Uploader
from specimap.service.context import AppContext, Context, audit
from specimap.service.files import AcquisitionId, File, FileId
from specimap.service.inspection import Arrival
from specimap.service.intake import forget_part, shown_name, take_in
from specimap.service.multipart import FormFiles, Part
from specimap.service.ranges import ranged_response
from specimap.service.room import (
    check_count,
    check_disks,
    check_size,
    largest,
    locked_acquisition,
    no_acquisition,
    quota_left,
)
from specimap.service.routers.acquisitions import check_idle
from specimap.service.routers.uploads import Files

router = APIRouter(prefix="/v1", tags=["files"])
DISK_EVERY = 64 * 1024 * 1024
FORM: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["role", "file"],
                    "properties": {
                        "role": {
                            "type": "string",
                            "enum": ["photo", "cube", "white", "dark"],
                            "description": "Of the files that follow it.",
                        },
                        "sha256": {"type": "string", "description": "Of the next file, in hexadecimal digits."},
                        "file": {"type": "array", "items": {"type": "string", "format": "binary"}},
                    },
                }
            }
        },
    }
}


class _Room:
    """The limits of one request; ``left`` bytes are left of the key's quota."""

    def __init__(self, context: AppContext, acquisition_id: str, left: int) -> None:
        self._context, self._acquisition_id, self._left = context, acquisition_id, left
        self._photos = 0
        self._asked_at = 0

    def begin(self, role: str, files: int) -> None:
        """One more file."""
        if role == "photo":
            self._photos += 1
            with self._context.database.session() as session:
                check_count(session, self._context.settings, self._acquisition_id, self._photos)
        elif files > 20:
            raise RequestInvalidError("More than 20 files in one form.", advice="Send fewer at a time.")

    def grow(self, role: str, size: int, total: int) -> None:
        """More bytes."""
        if size > largest(self._context.settings, role):
            check_size(self._context.settings, role, size)
        if total > self._left:
            raise _over_quota(self._left)
        if total - self._asked_at > DISK_EVERY:
            self._asked_at = total
            check_disks(self._context, 0)


def _over_quota(left: int) -> QuotaExceededError:
    return QuotaExceededError(
        f"The key's quota leaves {max(left, 0)} bytes.",
        advice="Delete acquisitions that are no longer needed, or ask the administrator for a higher quota.",
        left_bytes=max(left, 0),
    )


@router.post("/acquisitions/{acquisition_id}/files", status_code=201, openapi_extra=FORM)
async def add_files(
    context: Context, principal: Uploader, uploads: Files, request: Request, acquisition_id: AcquisitionId
) -> list[File]:
    """Send some files in one form: `role` before its files. For large files and shaky networks use /v1/uploads."""
    room = await asyncio.to_thread(_room, context, principal, request, acquisition_id)
    form = FormFiles(uploads.folder, room)
    try:
        parts = await form.read(request)
        context.metrics.uploaded.inc(sum(part.size for part in parts))
        return await asyncio.to_thread(_store, context, principal, acquisition_id, parts)
    finally:
        await asyncio.to_thread(form.close)


def _room(context: AppContext, principal: Principal, request: Request, acquisition_id: str) -> _Room:
    """All that can be refused before the body is read."""
    length = request.headers.get("content-length", "0")
    announced = int(length) if length.isdecimal() else 0
    settings = context.settings
    with context.database.session() as session:
        if session.get(Acquisition, acquisition_id) is None:
            raise no_acquisition(acquisition_id)
        left = quota_left(session, principal)
    check_disks(context, announced)
    # Boundaries, headers and fields of the form count as a mebibyte.
    most = max(settings.max_cube_bytes, settings.max_photo_bytes * settings.max_photos) + (1 << 20)
    if announced > most:
        check_size(settings, "cube", announced)
    if announced > left + (1 << 20):
        raise _over_quota(left)
    return _Room(context, acquisition_id, left)


def _store(context: AppContext, principal: Principal, acquisition_id: str, parts: list[Part]) -> list[File]:
    stored: list[File] = []
    for part in parts:
        if not part.size:
            raise RequestInvalidError("A file is empty.", advice="Send the file itself.", stored=[f.id for f in stored])
        row = take_in(
            context,
            Arrival(
                new_id("file"),
                acquisition_id,
                part.role,
                shown_name(part.name),
                part.path,
                part.size,
                part.sha256,
                principal.key_id,
                principal,
            ),
        )
        stored.append(File.model_validate(row))
    return stored


@router.get("/acquisitions/{acquisition_id}/files")
def list_files(context: Context, principal: Reader, acquisition_id: AcquisitionId) -> list[File]:
    """All files with their judgement, in the order in which they came."""
    with context.database.session() as session:
        if session.get(Acquisition, acquisition_id) is None:
            raise no_acquisition(acquisition_id)
        rows = session.scalars(
            sa.select(StoredFile).where(StoredFile.acquisition_id == acquisition_id).order_by(StoredFile.id)
        )
        return [File.model_validate(row) for row in rows]


@router.get("/acquisitions/{acquisition_id}/files/{file_id}")
def get_file(context: Context, principal: Reader, acquisition_id: AcquisitionId, file_id: FileId) -> File:
    """One file."""
    with context.database.session() as session:
        return File.model_validate(_found(session, acquisition_id, file_id))


@router.get(
    "/acquisitions/{acquisition_id}/files/{file_id}/content",
    response_class=Response,
    responses={200: {"content": {"application/octet-stream": {}}}, 206: {"content": {"application/octet-stream": {}}}},
)
def get_content(
    context: Context, principal: Reader, request: Request, acquisition_id: AcquisitionId, file_id: FileId
) -> Response:
    """The file's bytes as they were uploaded; ranges and ETags are understood."""
    with context.database.session() as session:
        row = _found(session, acquisition_id, file_id)
    kind = MEDIA_TYPES.get(PurePosixPath(row.label).suffix) if row.role == "photo" else None
    return ranged_response(request, context.storage, row.storage_key, kind or "application/octet-stream", row.label)


@router.delete("/acquisitions/{acquisition_id}/files/{file_id}", status_code=204)
def delete_file(context: Context, principal: Uploader, acquisition_id: AcquisitionId, file_id: FileId) -> None:
    """Delete a file, to send a better one. Not while a job works on the acquisition."""
    with context.database.session() as session:
        locked_acquisition(session, acquisition_id)
        row = _found(session, acquisition_id, file_id)
        check_idle(session, acquisition_id)
        forget_part(session, row)
        session.delete(row)
        audit(session, principal.key_id, "file.delete", file_id, acquisition=acquisition_id, role=row.role)
    context.storage.delete(row.storage_key)


def _found(session: Session, acquisition_id: str, file_id: str) -> StoredFile:
    row = session.get(StoredFile, file_id)
    if row is None or row.acquisition_id != acquisition_id:
        raise NotFoundError(f"There is no file {file_id} in {acquisition_id}.", advice="GET …/files lists all.")
    return row
