"""Exports: results as files for other programs, made once by a worker and kept."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, Field
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_core.export.formats import DEIDENTIFIED, KINDS, FileFormat, file_name
from specimap_infra import tables
from specimap_infra.errors import JobConflictError
from specimap_infra.export_state import state_hash
from specimap_infra.ids import new_id
from specimap_infra.labels import current_labels, lock_cloud
from specimap_infra.pseudonyms import Pseudonyms
from specimap_infra.queue import EXPORTS, MAKE_EXPORT, enqueue
from specimap_infra.tables import PRIORITIES
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.keys import Principal
from specimap_service.auth.object_ids import CloudId
from specimap_service.byte_ranges import REVALIDATED, ranged_response
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.clouds.open_clouds import CloudRecord
from specimap_service.context import AppContext, Context, audit, correlation_id
from specimap_service.idempotency import IdempotencyKey, Repeatable
from specimap_service.paging import After, MaybeLimit, Sort, listed, part_of

router = APIRouter(prefix="/v1/clouds/{cloud_id}/exports", tags=["exports"])


class Export(BaseModel):
    """A file made from a result."""

    id: str
    cloud_id: str
    format: FileFormat
    state: str = Field(description="As for a job: queued, running, succeeded, failed.", examples=["succeeded"])
    size: int | None = Field(description="Bytes, once it exists.")
    error: dict[str, Any] | None = Field(description="Code, message, advice and details of the failure.")
    created_at: datetime.datetime
    links: dict[str, str]


@router.post(
    "/{format}",
    status_code=202,
    responses={200: {"model": Export, "description": "The file exists already."}},
    operation_id="exports.create",
)
def create_export(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    response: Response,
    cloud_id: CloudId,
    format: FileFormat,
    idempotency_key: IdempotencyKey = None,
) -> Export:
    """Have a file made, once for each format; asked again, return its state.

    A failed export is tried again under a new id. `zarr` holds the label layers; if they have changed since, it is
    made again. So do `deidentified`, the result under pseudonyms, and `deidentified-inputs`, which has photos and cube
    too; they need the service's key of pseudonyms.
    """
    cloud = clouds.record(cloud_id)
    response.headers["Location"] = f"/v1/clouds/{cloud_id}/exports/{format.value}"
    if format is FileFormat.MESH_PLY:
        response.status_code = 200
        return _mesh_ply(context, cloud)
    replaced: str | None = None

    def make(session: Session, _: str) -> tuple[str, tables.Export]:
        nonlocal replaced
        row, replaced = _made(context, session, principal, cloud_id, format)
        return row.id, row

    def again(session: Session, export_id: str, _: str) -> tables.Export:
        row = session.get(tables.Export, export_id)
        if row is None:
            raise _no_export(cloud_id, format)
        return row

    request = Repeatable.of(principal, idempotency_key, "exports.create", {"cloud": cloud_id, "format": format.value})
    row, _ = request.once(context.database, make, again)
    if replaced is not None:
        context.storage.delete(f"exports/{replaced}")
    response.status_code = 200 if row.state == "succeeded" else 202
    return _view(row)


def _made(
    context: AppContext, session: Session, principal: Principal, cloud_id: str, format: FileFormat
) -> tuple[tables.Export, str | None]:
    """Return the row of an export, new where there is none of use, and the id of the one that it replaces."""
    replaced: str | None = None
    lock_cloud(session, cloud_id)
    if format in DEIDENTIFIED:
        Pseudonyms.of(context.settings)
    row = session.scalar(_query(cloud_id, format))
    if row is not None and (
        row.state in ("failed", "cancelled")
        or (
            row.state == "succeeded"
            and row.labels_hash != state_hash(format, current_labels(session, cloud_id), context.settings)
        )
    ):
        replaced = row.id
        session.delete(row)
        session.flush()
        row = None
    if row is None:
        row = tables.Export(
            id=new_id("exp"),
            cloud_id=cloud_id,
            format=format.value,
            state="queued",
            correlation_id=correlation_id(),
            created_by=principal.key_id,
        )
        session.add(row)
        session.flush()
        enqueue(context.queue, session, EXPORTS, MAKE_EXPORT, row.id, PRIORITIES["routine"])
        audit(session, principal.key_id, "export.create", row.id, cloud=cloud_id, format=format.value)
    return row, replaced


@router.get("", operation_id="exports.list")
def list_exports(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "-created_at",
) -> list[Export]:
    """List the files that exist or are being made; `mesh-ply` always exists."""
    cloud = clouds.record(cloud_id)
    query = sa.select(tables.Export).where(tables.Export.cloud_id == cloud_id)
    with context.database.session() as session:
        exports = [_mesh_ply(context, cloud), *map(_view, session.scalars(query))]
    # The mesh is as old as the cloud, so its place is among the others.
    exports = part_of(exports, lambda export: export.id, after, limit, sort)
    return listed(request, response, exports, [export.id for export in exports], limit)


@router.get("/{format}", operation_id="exports.get")
def get_export(
    context: Context, principal: Permitted, clouds: CloudsDep, cloud_id: CloudId, format: FileFormat
) -> Export:
    """Return the state of a file."""
    cloud = clouds.record(cloud_id)
    return _mesh_ply(context, cloud) if format is FileFormat.MESH_PLY else _view(_found(context, cloud_id, format))


FILE: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "The file.",
        "content": {
            media: {"schema": {"type": "string", "format": "binary"}}
            for media in sorted({kind.media_type for kind in KINDS.values()})
        },
    },
    206: {"description": "The range that was requested."},
    304: {"description": "The client has the current file."},
    412: {"description": "The file is not the one that If-Match names."},
    416: {"description": "The range lies outside of the file."},
}


@router.head("/{format}/content", response_class=Response, responses=FILE, operation_id="exports.head_content")
@router.get("/{format}/content", response_class=Response, responses=FILE, operation_id="exports.get_content")
def get_content(
    context: Context, principal: Permitted, clouds: CloudsDep, request: Request, cloud_id: CloudId, format: FileFormat
) -> Response:
    """Return the file itself; single byte ranges let a broken download continue."""
    cloud = clouds.record(cloud_id)
    if format is FileFormat.MESH_PLY:
        key: str | None = _mesh_key(cloud)
    else:
        row = _found(context, cloud_id, format)
        key = row.storage_key if row.state == "succeeded" else None
        if key is None:
            raise JobConflictError(
                f"The export is {row.state}.",
                advice="GET the export until it has succeeded; POST tries a failed one again.",
                state=row.state,
            )
    kind = KINDS[format]
    return ranged_response(
        request, context.storage, key or "", kind.media_type, _name(context, cloud_id, format), cache=REVALIDATED
    )


def _name(context: AppContext, cloud_id: str, format: FileFormat) -> str:
    """Return the file's name; that of a de-identified one holds the result's pseudonym alone."""
    named = Pseudonyms.of(context.settings).of_text("result", cloud_id) if format in DEIDENTIFIED else cloud_id
    return file_name(named, format)


def _query(cloud_id: str, format: FileFormat) -> sa.Select[tables.Export]:
    return sa.select(tables.Export).where(tables.Export.cloud_id == cloud_id, tables.Export.format == format.value)


def _found(context: AppContext, cloud_id: str, format: FileFormat) -> tables.Export:
    with context.database.session() as session:
        row = session.scalar(_query(cloud_id, format))
    if row is None:
        raise _no_export(cloud_id, format)
    return row


def _no_export(cloud_id: str, format: FileFormat) -> NotFoundError:
    return NotFoundError(
        f"There is no export of {cloud_id} as {format.value}.", advice="POST to the same address has it made."
    )


def _mesh_key(cloud: CloudRecord) -> str:
    return f"{cloud.prefix}/mesh.ply"


def _mesh_ply(context: AppContext, cloud: CloudRecord) -> Export:
    """Describe the mesh as the run wrote it: an export that needs no row."""
    return Export(
        id=cloud.id.replace("cloud_", "exp_"),
        cloud_id=cloud.id,
        format=FileFormat.MESH_PLY,
        state="succeeded",
        size=context.storage.stat(_mesh_key(cloud)).size,
        error=None,
        created_at=cloud.created_at,
        links=_links(cloud.id, FileFormat.MESH_PLY),
    )


def _view(row: tables.Export) -> Export:
    return Export(
        id=row.id,
        cloud_id=row.cloud_id,
        format=FileFormat(row.format),
        state=row.state,
        size=row.size,
        error=row.error,
        created_at=row.created_at,
        links=_links(row.cloud_id, FileFormat(row.format)),
    )


def _links(cloud_id: str, format: FileFormat) -> dict[str, str]:
    own = f"/v1/clouds/{cloud_id}/exports/{format.value}"
    return {"self": own, "content": f"{own}/content"}
