"""Upload of several files of an acquisition in one form."""

from __future__ import annotations

import asyncio
from functools import partial
from typing import Any

from fastapi import APIRouter, Request

from specimap_infra.ids import new_id
from specimap_infra.tables import Acquisition
from specimap_service.acquisitions.capacity import (
    check_count,
    check_size,
    max_file_bytes,
)
from specimap_service.acquisitions.inspection import Arrival
from specimap_service.acquisitions.intake import clean_name, take_in
from specimap_service.acquisitions.schemas import File
from specimap_service.auth.access import not_found
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.keys import Principal
from specimap_service.auth.object_ids import AcquisitionId
from specimap_service.context import AppContext, Context
from specimap_service.errors import QuotaExceededError, RequestInvalidError
from specimap_service.space import DISK_EVERY, check_disks, quota_left
from specimap_service.uploads.dependencies import UploadsDep
from specimap_service.uploads.lifecycle import Uploads
from specimap_service.uploads.multipart import FormFiles, Part

router = APIRouter(prefix="/v1", tags=["files"])
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
                },
                "example": {"role": "photo", "file": ["the bytes of IMG_1.jpg"]},
            }
        },
    }
}


class _FormLimits:
    """The limits of one request; ``left`` bytes are left of the key's quota."""

    def __init__(self, context: AppContext, acquisition_id: str, left: int) -> None:
        self._context, self._acquisition_id, self._left = context, acquisition_id, left
        self._photos = 0
        self._disk_checked_at = 0

    def begin(self, role: str, files: int) -> None:
        """Check that one more file may be added."""
        if role == "photo":
            self._photos += 1
            with self._context.database.session() as session:
                check_count(session, self._context.settings, self._acquisition_id, self._photos)
        elif files > 20:
            raise RequestInvalidError("More than 20 files in one form.", advice="Send fewer at a time.")

    def grow(self, role: str, size: int, total: int) -> None:
        """Check that a file may have ``size`` bytes, and all files together ``total``."""
        if size > max_file_bytes(self._context.settings, role):
            check_size(self._context.settings, role, size)
        if total > self._left:
            raise _quota_exceeded(self._left)
        if total - self._disk_checked_at > DISK_EVERY:
            self._disk_checked_at = total
            check_disks(self._context, 0)


def _quota_exceeded(left: int) -> QuotaExceededError:
    return QuotaExceededError(
        f"The key's quota leaves {max(left, 0)} bytes.",
        advice="Delete acquisitions that are no longer needed, or ask the administrator for a higher quota.",
        left_bytes=max(left, 0),
    )


@router.post("/acquisitions/{acquisition_id}/files", status_code=201, openapi_extra=FORM, operation_id="files.create")
async def add_files(
    context: Context, principal: Permitted, uploads: UploadsDep, request: Request, acquisition_id: AcquisitionId
) -> list[File]:
    """Send some files in one form: `role` before its files. For large files and shaky networks use /v1/uploads."""
    limits = await asyncio.to_thread(_limits, context, principal, request, acquisition_id)
    form = FormFiles(uploads.files.folder, limits)
    try:
        parts = await form.read(request)
        context.metrics.uploaded.inc(sum(part.size for part in parts))
        stored: list[File] = []
        for part in parts:
            work = partial(_store, uploads, principal, acquisition_id, part, stored)
            # The first may be refused, and is given up where its client goes away; those after it wait, so that a form
            # does not end half stored.
            stored.append(
                await uploads.intake.go_on(principal.key_id, work)
                if stored
                else await uploads.intake.run_while(request.receive, principal.key_id, work)
            )
        return stored
    finally:
        await asyncio.to_thread(form.close)


def _limits(context: AppContext, principal: Principal, request: Request, acquisition_id: str) -> _FormLimits:
    """Check before the body is read whatever can be checked then; return the limits for the rest."""
    length = request.headers.get("content-length", "0")
    announced = int(length) if length.isdecimal() else 0
    settings = context.settings
    with context.database.session() as session:
        if session.get(Acquisition, acquisition_id) is None:
            raise not_found(acquisition_id)
        left = quota_left(session, principal)
    check_disks(context, announced)
    # Boundaries, headers and fields of the form count as a mebibyte.
    most = max(settings.max_cube_bytes, settings.max_photo_bytes * settings.max_photos) + (1 << 20)
    if announced > most:
        check_size(settings, "cube", announced)
    if announced > left + (1 << 20):
        raise _quota_exceeded(left)
    return _FormLimits(context, acquisition_id, left)


def _store(uploads: Uploads, principal: Principal, acquisition_id: str, part: Part, before: list[File]) -> File:
    if not part.size:
        raise RequestInvalidError("A file is empty.", advice="Send the file itself.", stored=[f.id for f in before])
    row = take_in(
        uploads.context,
        uploads.judge,
        Arrival(
            new_id("file"),
            acquisition_id,
            part.role,
            clean_name(part.name),
            part.path,
            part.size,
            part.sha256,
            principal.key_id,
            principal,
        ),
    )
    return File.model_validate(row)
