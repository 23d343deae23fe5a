"""``/v1/clouds/{id}/zarr``: a cloud as a Zarr v3 group that any Zarr client reads."""

from __future__ import annotations

import json
from typing import Annotated, Any

from fastapi import APIRouter, Path, Request
from starlette.responses import Response

from specimap_core.cloud import ARRAYS
from specimap_core.cloud.shards import damage
from specimap_core.cloud.source import ByteSource
from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_text
from specimap_infra.storage import Storage
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import CloudId
from specimap_service.byte_ranges import CACHED, REVALIDATED, ranged_bytes, ranged_response
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.clouds.open_clouds import CloudRecord
from specimap_service.clouds.stored_folder import StoredFolder
from specimap_service.context import Context

router = APIRouter(prefix="/v1", tags=["zarr"])
DOCUMENT = "zarr.json"
GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group", "attributes": {}}
JSON, BYTES = "application/json", "application/octet-stream"
_FILE = {"schema": {"type": "string", "format": "binary"}}
_ANSWERS: dict[int | str, dict[str, Any]] = {
    200: {"description": "The file", "content": {BYTES: _FILE, JSON: {"schema": {"type": "object"}}}},
    206: {"description": "The byte range", "content": {BYTES: _FILE}},
    304: {"description": "The client has the current file"},
}


@router.head(
    "/clouds/{cloud_id}/zarr/{key:path}", response_class=Response, responses=_ANSWERS, operation_id="zarr.head"
)
@router.get("/clouds/{cloud_id}/zarr/{key:path}", response_class=Response, responses=_ANSWERS, operation_id="zarr.get")
def zarr_file(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    cloud_id: CloudId,
    key: Annotated[str, Path(description="As in the group: `zarr.json`, `spectra/c/0/0`, `labels/tissue/zarr.json`.")],
) -> Response:
    """Return a file of the group, as stored; with single byte ranges and ETags.

    Two documents are made on request, so that clients find the arrays without listing files: `zarr.json` with
    consolidated metadata, also of the labels, and `labels/zarr.json` with those of the labels. Labels appear as
    `labels/<name>`, in their current version.
    """
    record = clouds.record(cloud_id)
    # Every key is made of characters that need no escape: an escaped one does not exist, whatever it decodes to.
    if b"%" in request.scope.get("raw_path", b""):
        raise _no_file(key)
    if key in (DOCUMENT, f"labels/{DOCUMENT}"):
        with clouds.reading(cloud_id) as (record, _):
            return ranged_bytes(request, _group_document(context.storage, record, labels=key != DOCUMENT), JSON)
    array, _, rest = key.partition("/")
    if array == "labels":
        name, _, rest = rest.partition("/")
        label = record.labels.get(name)
        folder, cache = label.prefix if label else None, REVALIDATED
    else:
        folder, cache = f"{record.zarr}/{array}" if array in ARRAYS else None, CACHED
    if folder is None or not rest:
        raise _no_file(key)
    try:
        return ranged_response(
            request, context.storage, f"{folder}/{rest}", JSON if rest == DOCUMENT else BYTES, cache=cache
        )
    except NotFoundError as error:
        # The storage's own message names the place of the file.
        raise _no_file(key) from error


def _no_file(key: str) -> NotFoundError:
    return NotFoundError(f"There is no file {key[:200]!r} in the cloud.", advice="zarr.json lists the arrays.")


def _group_document(storage: Storage, record: CloudRecord, *, labels: bool) -> bytes:
    """Make ``zarr.json`` of the cloud's group, or of the group of its labels, with consolidated metadata."""
    own = {name: _document(StoredFolder(storage, label.prefix), DOCUMENT) for name, label in record.labels.items()}
    if labels:
        if not own:
            raise _no_file(f"labels/{DOCUMENT}")
        document, members = dict(GROUP), own
    else:
        source = StoredFolder(storage, record.zarr)
        document = _document(source, DOCUMENT)
        members = {name: _document(source, f"{name}/{DOCUMENT}") for name in ARRAYS}
        if own:
            members |= {"labels": GROUP, **{f"labels/{name}": found for name, found in own.items()}}
    document["consolidated_metadata"] = {"kind": "inline", "must_understand": False, "metadata": members}
    return json_text(document).encode()


def _document(source: ByteSource, key: str) -> dict[str, Any]:
    with damage(source, key.rpartition("/")[0]):
        found: dict[str, Any] = json.loads(source.read(key))
        return found
