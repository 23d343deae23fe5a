"""Label layers: written by classifiers and people, versioned, read as arrays."""

from __future__ import annotations

from functools import partial
from pathlib import Path as FilePath
from typing import Annotated, Any, Literal
from uuid import uuid4

import numpy as np
import sqlalchemy as sa
from anyio import to_thread
from fastapi import APIRouter, Header, Path, Query, Request, Response
from starlette.concurrency import run_in_threadpool

from specimap_core.atomic import disk_errors, remove
from specimap_infra.labels import current_labels
from specimap_infra.tables import LabelVersion
from specimap_service.array_responses import (
    ARROW,
    JSON,
    NPY,
    Rows,
    arrow_answer,
    chosen_type,
    documented_responses,
    json_rows_answer,
    npy_answer,
)
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.keys import Principal
from specimap_service.auth.object_ids import CloudId
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.clouds.label_body import (
    EXAMPLE_TEXT,
    HEADER,
    LabelMetadata,
    most_bytes,
    parse_metadata,
    parse_values,
)
from specimap_service.clouds.label_schemas import Label, LabelValues
from specimap_service.clouds.label_store import Conditions, check_room, delete_label, find_label, no_label, put_label
from specimap_service.clouds.open_clouds import LabelRecord, OpenClouds
from specimap_service.context import AppContext, Context
from specimap_service.errors import MediaTypeError, PayloadTooLargeError
from specimap_service.paging import MaybeLimit, Sort, listed, part_of
from specimap_service.space import DISK_EVERY, check_disks

router = APIRouter(prefix="/v1", tags=["labels"])
LabelName = Annotated[str, Path(pattern=r"^[a-z0-9_-]{1,64}$")]
Version = Annotated[int | None, Query(ge=1, le=10**9, description="By default the current version.")]
AfterName = Annotated[str | None, Query(pattern=r"^[a-z0-9_-]{1,64}$", description="Name of the last one seen.")]
AfterVersion = Annotated[int | None, Query(ge=1, le=10**9, description="Number of the last version seen.")]
SortByName = Annotated[Literal["name", "-name"], Query(description="By name, forwards or backwards.")]
_SENT_TOGETHER = 1024 * 1024


BINARY = {"schema": {"type": "string", "format": "binary"}}


@router.put(
    "/clouds/{cloud_id}/labels/{name}",
    status_code=201,
    responses={200: {"model": Label, "description": "The current version is the same; nothing was changed."}},
    openapi_extra={"requestBody": {"required": True, "content": {ARROW: BINARY, NPY: BINARY}}},
    operation_id="labels.put",
)
async def put(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    name: LabelName,
    label: Annotated[
        str | None,
        Header(alias=HEADER, description="Kind, classes and made_by as JSON. Required.", examples=[EXAMPLE_TEXT]),
    ] = None,
    if_match: Annotated[str | None, Header(description='The version to replace, as `"3"`; `*`: any version.')] = None,
    if_none_match: Annotated[str | None, Header(description="`*`: store only if there is no such layer.")] = None,
) -> Label:
    """Store a layer's next version, in the order of the cloud's points.

    An Arrow stream holds one column `value`, or for probabilities of several classes one column for each, named as
    the class; it is not compressed. A npy file holds (S,), or (S, C) in the order of `classes`. Kind `class`: whole
    numbers, each that of a class; name a class for unlabelled points too. Kind `probability`: 0 to 1; NaN or null
    where it is unknown.
    """
    metadata, conditions = parse_metadata(label), Conditions.of(if_match, if_none_match)
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media not in (ARROW, NPY):
        raise MediaTypeError(f"{HEADER} comes with an array.", advice=f"Send {ARROW} or {NPY}.", offered=[ARROW, NPY])
    points = (await run_in_threadpool(clouds.record, cloud_id)).points
    scratch = context.settings.scratch / f"label-{uuid4().hex}.body.tmp"
    try:
        await _receive(context, principal, request, scratch, most_bytes(metadata, points))

        def store() -> tuple[LabelVersion, bool]:
            values = parse_values(scratch, media == ARROW, metadata, points)
            return put_label(context, clouds, principal, cloud_id, name, metadata, values, conditions)

        row, new = await run_in_threadpool(store)
    finally:
        await run_in_threadpool(remove, scratch)
    response.status_code = 201 if new else 200
    response.headers["ETag"] = f'"{row.version}"'
    response.headers["Location"] = f"/v1/clouds/{cloud_id}/labels/{name}?version={row.version}"
    return _view(row)


async def _receive(context: AppContext, principal: Principal, request: Request, target: FilePath, limit: int) -> None:
    """Write the body to a file. Raises PayloadTooLargeError, QuotaExceededError, StorageFullError."""
    too_large = PayloadTooLargeError(
        "The body is larger than these labels can be.", advice="Send a value for each point.", limit_bytes=limit
    )
    length = request.headers.get("content-length", "")
    if length.isdecimal() and int(length) > limit:
        raise too_large
    await to_thread.run_sync(check_room, context, principal, int(length) if length.isdecimal() else 0)
    size, checked_at, pieces = 0, 0, bytearray()
    with disk_errors(target):
        async for piece in request.stream():
            size += len(piece)
            if size > limit:
                raise too_large
            pieces += piece
            if size - checked_at > DISK_EVERY:
                checked_at = size
                await to_thread.run_sync(check_disks, context, 0)
            if len(pieces) >= _SENT_TOGETHER:
                await to_thread.run_sync(partial(_append, target, bytes(pieces)))
                pieces.clear()
        await to_thread.run_sync(partial(_append, target, bytes(pieces)))


def _append(target: FilePath, data: bytes) -> None:
    with open(target, "ab") as file:
        file.write(data)


@router.get("/clouds/{cloud_id}/labels", operation_id="labels.list")
def list_labels(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    after: AfterName = None,
    limit: MaybeLimit = None,
    sort: SortByName = "name",
) -> list[Label]:
    """List the current version of each layer."""
    clouds.record(cloud_id)
    with context.database.session() as session:
        labels = list(map(_view, current_labels(session, cloud_id)))
    labels = part_of(labels, lambda label: label.name, after, limit, sort)
    return listed(request, response, labels, [label.name for label in labels], limit)


@router.get("/clouds/{cloud_id}/labels/{name}", operation_id="labels.get")
def get_label(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    response: Response,
    cloud_id: CloudId,
    name: LabelName,
    version: Version = None,
) -> Label:
    """Return a layer's metadata; its ETag is the version, for If-Match."""
    row = _find(context, clouds, cloud_id, name, version)
    response.headers["ETag"] = f'"{row.version}"'
    return _view(row)


@router.get("/clouds/{cloud_id}/labels/{name}/versions", operation_id="labels.list_versions")
def list_versions(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    name: LabelName,
    after: AfterVersion = None,
    limit: MaybeLimit = None,
    sort: Sort = "-created_at",
) -> list[Label]:
    """List the versions of a layer."""
    clouds.record(cloud_id)
    query = sa.select(LabelVersion).where(LabelVersion.cloud_id == cloud_id, LabelVersion.name == name)
    with context.database.session() as session:
        versions = list(map(_view, session.scalars(query)))
    if not versions:
        raise no_label(cloud_id, name)
    versions = part_of(versions, lambda label: label.version, after, limit, sort)
    return listed(request, response, versions, [label.version for label in versions], limit)


@router.get(
    "/clouds/{cloud_id}/labels/{name}/values",
    response_model=None,
    responses=documented_responses(LabelValues),
    operation_id="labels.get_values",
)
def get_values(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    cloud_id: CloudId,
    name: LabelName,
    version: Version = None,
) -> Response:
    """Return a layer's values in the order of the cloud's points, in the formats that PUT takes, or as JSON."""
    media = chosen_type(request)
    row = _find(context, clouds, cloud_id, name, version)
    headers = {"X-Specimap-Label-Version": str(row.version)}
    record = LabelRecord(row.name, row.version, row.kind, row.storage_prefix)
    with clouds.reading(cloud_id):
        array = clouds.label_array(record)
        if media == NPY:
            return npy_answer(array.shape, array.read, headers, dtype=array.dtype)
        if media == ARROW:
            names = [item["name"] for item in row.classes] if len(array.shape) == 2 else ["value"]
            described = {"kind": row.kind, "version": str(row.version)}

            def columns(start: int, stop: int) -> dict[str, np.ndarray[Any, Any]]:
                values = array.read(start, stop).reshape(stop - start, -1)
                return {name: np.ascontiguousarray(values[:, i]) for i, name in enumerate(names)}

            return arrow_answer(array.shape[0], columns, described, headers)
        assert media == JSON
        shown = {
            "cloud_id": cloud_id,
            "name": name,
            "version": row.version,
            "kind": row.kind,
            "classes": row.classes,
        }
        width = int(np.prod(array.shape[1:]))
        return json_rows_answer(shown, "values", Rows(array.shape[0], width, array.read), headers=headers)


@router.delete("/clouds/{cloud_id}/labels/{name}", status_code=204, operation_id="labels.delete")
def delete(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    cloud_id: CloudId,
    name: LabelName,
    if_match: Annotated[str | None, Header(description='The current version, as `"3"`; `*`: any.')] = None,
) -> None:
    """Delete a layer with all its versions."""
    delete_label(context, clouds, principal, cloud_id, name, Conditions.of(if_match, None))


def _find(context: AppContext, clouds: OpenClouds, cloud_id: str, name: str, version: int | None) -> LabelVersion:
    clouds.record(cloud_id)
    with context.database.session() as session:
        return find_label(session, cloud_id, name, version)


def _view(row: LabelVersion) -> Label:
    base = f"/v1/clouds/{row.cloud_id}"
    own = f"{base}/labels/{row.name}"
    metadata = LabelMetadata(kind=row.kind, classes=row.classes, made_by=row.made_by)  # type: ignore[arg-type]
    return Label(
        cloud_id=row.cloud_id,
        name=row.name,
        version=row.version,
        kind=row.kind,
        classes=metadata.classes,
        made_by=metadata.made_by,
        sha256=row.sha256,
        created_at=row.created_at,
        created_by=row.created_by,
        links={
            "self": f"{own}?version={row.version}",
            "values": f"{own}/values?version={row.version}",
            "preview": f"{base}/previews/label.png?name={row.name}&version={row.version}",
            "zarr": f"{base}/zarr/labels/{row.name}",
        },
    )
