"""Files of an acquisition: listed with their judgement, read, deleted."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_core.photos.formats import MEDIA_TYPES
from specimap_infra.tables import Acquisition, StoredFile
from specimap_service.acquisitions.capacity import locked_acquisition
from specimap_service.acquisitions.intake import forget_part
from specimap_service.acquisitions.routes import check_idle
from specimap_service.acquisitions.schemas import File, FileId
from specimap_service.auth.access import not_found
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import AcquisitionId
from specimap_service.byte_ranges import ranged_response
from specimap_service.context import Context, audit
from specimap_service.paging import After, MaybeLimit, Sort, listed, paged

router = APIRouter(prefix="/v1", tags=["files"])
BYTES: dict[str, Any] = {
    "description": "The file's bytes, or the range that was requested",
    "content": {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}},
}


@router.get("/acquisitions/{acquisition_id}/files", operation_id="files.list")
def list_files(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    acquisition_id: AcquisitionId,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "created_at",
) -> list[File]:
    """List the files with their judgement, by default in the order of their arrival."""
    query = sa.select(StoredFile).where(StoredFile.acquisition_id == acquisition_id)
    with context.database.session() as session:
        if session.get(Acquisition, acquisition_id) is None:
            raise not_found(acquisition_id)
        rows = session.scalars(paged(query, StoredFile.id, after, limit, sort))
        files = [File.model_validate(row) for row in rows]
    return listed(request, response, files, [file.id for file in files], limit)


@router.get("/acquisitions/{acquisition_id}/files/{file_id}", operation_id="files.get")
def get_file(context: Context, principal: Permitted, acquisition_id: AcquisitionId, file_id: FileId) -> File:
    """Return one file."""
    with context.database.session() as session:
        return File.model_validate(_found(session, acquisition_id, file_id))


@router.get(
    "/acquisitions/{acquisition_id}/files/{file_id}/content",
    response_class=Response,
    responses={200: BYTES, 206: BYTES},
    operation_id="files.get_content",
)
def get_content(
    context: Context, principal: Permitted, request: Request, acquisition_id: AcquisitionId, file_id: FileId
) -> Response:
    """Return the file's bytes as they were uploaded; ranges and ETags are supported."""
    with context.database.session() as session:
        row = _found(session, acquisition_id, file_id)
    kind = MEDIA_TYPES.get(PurePosixPath(row.label).suffix) if row.role == "photo" else None
    return ranged_response(request, context.storage, row.storage_key, kind or "application/octet-stream", row.label)


@router.delete("/acquisitions/{acquisition_id}/files/{file_id}", status_code=204, operation_id="files.delete")
def delete_file(context: Context, principal: Permitted, acquisition_id: AcquisitionId, file_id: FileId) -> None:
    """Delete a file, to send a better one. Refused while a job works on the acquisition."""
    with context.database.session() as session:
        locked_acquisition(session, acquisition_id)
        row = _found(session, acquisition_id, file_id)
        check_idle(session, acquisition_id)
        forget_part(session, row)
        audit(session, principal.key_id, "file.delete", file_id, acquisition=acquisition_id, role=row.role)
        session.delete(row)
    context.storage.delete(row.storage_key)


def _found(session: Session, acquisition_id: str, file_id: str) -> StoredFile:
    row = session.get(StoredFile, file_id)
    if row is None or row.acquisition_id != acquisition_id:
        raise NotFoundError(f"There is no file {file_id} in {acquisition_id}.", advice="GET …/files lists all.")
    return row
