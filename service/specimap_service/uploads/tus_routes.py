"""Routes of the tus protocol 1.0 (tus.io): those of the library, with our checks before them and our hooks within."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import Awaitable, Callable
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from tuspyserver import create_tus_router

from specimap_infra.tables import Upload
from specimap_service.auth.dependencies import Permitted
from specimap_service.context import CONTEXT, Context
from specimap_service.errors import RequestInvalidError
from specimap_service.idempotency import IdempotencyKey
from specimap_service.uploads import tus
from specimap_service.uploads.dependencies import UPLOADS, UploadsDep
from specimap_service.uploads.files import UploadBytes
from specimap_service.uploads.lifecycle import Uploads, check_alive
from specimap_service.uploads.tus_store import UploadStore

OCTETS = "application/offset+octet-stream"


# ---- before the library sees a request ----------------------------------------------------------------


async def _check_request(request: Request, principal: Permitted, uploads: UploadsDep) -> None:
    """Check before the body is read whatever can be checked then; the library checks most of it afterwards."""
    exchange, headers = tus.exchange(), request.headers
    exchange.principal = principal
    if headers.get("tus-resumable") != tus.VERSION:
        raise HTTPException(412, f"Tus-Resumable must be {tus.VERSION}")
    if request.method == "POST":
        _check_creation(request)
        return
    upload = exchange.upload = await uploads.current(
        request.path_params["uuid"], principal, exchange.connection if request.method == "HEAD" else None
    )
    check_alive(upload)
    if upload.state != "open":
        await run_in_threadpool(_add_result_headers, uploads, upload, exchange)
    if request.method == "HEAD":
        given = {"acquisition": upload.acquisition_id, "role": upload.role, "filename": upload.name}
        exchange.headers["Upload-Metadata"] = ",".join(f"{key} {_base64(value)}" for key, value in given.items())
    if request.method == "PATCH":
        await run_in_threadpool(_check_chunk, request, upload, uploads.files, exchange)


def _base64(value: str) -> str:
    return base64.b64encode(value.encode()).decode()


def _check_creation(request: Request) -> None:
    headers = request.headers
    for name in ("Upload-Concat", "Upload-Defer-Length"):
        if name.lower() in headers:
            raise RequestInvalidError(
                f"{name} is not served here.", advice="OPTIONS /v1/uploads tells the extensions that are.", field=name
            )
    if headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
        raise RequestInvalidError(
            "An upload is created without content.",
            advice="Create it with an empty body, then send the bytes with PATCH.",
        )


def _check_chunk(request: Request, upload: Upload, files: UploadBytes, exchange: tus.Exchange) -> None:
    headers = request.headers
    if headers.get("content-type") != OCTETS:
        raise HTTPException(415, f"Content-Type must be {OCTETS}")
    if not headers.get("upload-offset", "").isdecimal():
        raise HTTPException(400, "Upload-Offset is missing or no number")
    left = upload.size - (upload.size if upload.state != "open" else files.size(upload.id) or 0)
    length = headers.get("content-length", "0")
    if int(headers["upload-offset"]) + left == upload.size and length.isdecimal() and int(length) > left:
        raise tus.too_long()
    if "upload-checksum" in headers:
        exchange.checksum = tus.parsed_checksum(headers["upload-checksum"])


async def _verify_checksum(uploads: UploadsDep, _: Annotated[None, Depends(_check_request)]) -> None:
    exchange = tus.exchange()
    if exchange.checksum is not None and exchange.upload is not None:
        await exchange.verify(exchange.upload.size, uploads.files.folder)


# ---- the library's hooks ------------------------------------------------------------------------------


def _creation_hook(
    context: Context, uploads: UploadsDep, idempotency_key: IdempotencyKey = None
) -> Callable[[dict[str, str], dict[str, Any]], Awaitable[None]]:
    async def create(metadata: dict[str, str], info: dict[str, Any]) -> None:
        exchange = tus.exchange()
        assert exchange.principal is not None
        upload = await asyncio.to_thread(uploads.create, exchange.principal, metadata, info["size"], idempotency_key)
        exchange.upload = upload
        exchange.headers["Location"] = f"{context.settings.public_url.rstrip('/')}{tus.PREFIX}/{upload.id}"
        exchange.headers["Upload-Expires"] = tus.http_date(upload)

    return create


def _naming_hook() -> Callable[[dict[str, str]], dict[str, str]]:
    def name(metadata: dict[str, str]) -> dict[str, str]:
        upload = tus.exchange().upload
        return {} if upload is None else {"uid": upload.id}

    return name


def _completion_hook(uploads: UploadsDep) -> Callable[[str, dict[str, str]], Awaitable[None]]:
    async def complete(upload_id: str, metadata: dict[str, str]) -> None:
        exchange = tus.exchange()
        if exchange.upload is not None and exchange.upload.state == "open":
            exchange.upload = await uploads.finish_in_turn(exchange.upload, exchange.connection)
        if exchange.upload is not None:
            await asyncio.to_thread(_add_result_headers, uploads, exchange.upload, exchange)

    return complete


def _add_result_headers(uploads: Uploads, upload: Upload, exchange: tus.Exchange) -> None:
    """Name the stored file of a finished upload, and its verdict, in the answer's headers."""
    if upload.state == "failed":
        exchange.headers["Specimap-Verdict"] = "refused"
    stored = uploads.stored_file(upload)
    if stored is not None:
        exchange.headers["Specimap-File"] = stored.id
        exchange.headers["Specimap-Verdict"] = stored.judgement["verdict"]


# ---- setting up ---------------------------------------------------------------------------------------


_BODY: dict[str, Any] = {
    "requestBody": {"required": True, "content": {OCTETS: {"schema": {"type": "string", "format": "binary"}}}},
    "parameters": [
        {
            "name": "Upload-Checksum",
            "in": "header",
            "required": False,
            "schema": {"type": "string"},
            "description": "sha1, sha256 or md5 of the body, a space, and the digest in base64.",
        }
    ],
}
DOCUMENTED: dict[str, dict[str, Any]] = {
    "POST": {
        "id": "uploads.create",
        "summary": "Create an upload",
        "description": "`Upload-Metadata`: `acquisition` (its id), `role` (photo, cube, white, dark), `filename`, each "
        "with its value in base64. The answer's `Location` takes the bytes. The body is empty.",
        "headers": ("Location", "Upload-Expires"),
    },
    "HEAD": {
        "id": "uploads.get_offset",
        "summary": "Ask how much has arrived",
        "description": "`Upload-Offset` says where to continue.",
        "headers": ("Upload-Offset", "Upload-Length", "Upload-Metadata"),
    },
    "PATCH": {
        "id": "uploads.append",
        "summary": "Send bytes",
        "description": "From `Upload-Offset` on; with `Upload-Checksum` (sha1, sha256 or md5, and the digest in "
        "base64) all or nothing: 460 where it differs. The answer to the last byte comes when the file has been "
        "judged, and carries `Specimap-File` and `Specimap-Verdict`; `GET …/result` says more.",
        "headers": ("Upload-Offset", "Upload-Expires", "Specimap-File", "Specimap-Verdict"),
    },
    "DELETE": {
        "id": "uploads.delete",
        "summary": "End an upload",
        "description": "Its bytes are removed.",
        "headers": (),
    },
}


NEEDED: dict[str, dict[str, Any]] = {
    "tus-resumable": {"type": "string", "enum": [tus.VERSION]},
    "upload-metadata": {"type": "string"},
    "upload-length": {"type": "integer", "minimum": 1},
    "upload-offset": {"type": "integer", "minimum": 0},
}
"""Headers without which the library's routes that have them refuse."""
NOT_SERVED: dict[str, tuple[str, ...]] = {
    "POST": ("upload-concat", "upload-defer-length"),
    "PATCH": ("upload-length", "post_request"),
}
"""Parameters of the library's routes, by method, that belong to extensions which are not served."""


def _document(route: APIRoute) -> None:
    method = next(iter(route.methods or ()))
    about = DOCUMENTED[method]
    status = str(route.status_code)
    route.operation_id, route.summary, route.description = about["id"], about["summary"], about["description"]
    route.response_class = Response
    # POST to an address that ends in a slash, as some clients do, is the same.
    route.include_in_schema = not route.path.endswith("/")
    answer = {name: {"schema": {"type": "string"}} for name in about["headers"]}
    if method == "PATCH":
        route.openapi_extra = _BODY
    route.responses = {status: {"description": about["summary"], "headers": answer}}


def mount(app: FastAPI) -> None:
    """Add the tus routes to an app whose features are open."""
    context, uploads = CONTEXT.of(app), UPLOADS.of(app)
    store = UploadStore(
        uploads.files, received=context.metrics.uploaded.inc, delete=uploads.terminate, renewed=uploads.renewed
    )
    # The library's annotations do not say that hooks may be coroutines and return a value.
    hooks: dict[str, Any] = {
        "pre_create_dep": _creation_hook,
        "upload_complete_dep": _completion_hook,
        "file_dep": _naming_hook,
    }
    library = create_tus_router(
        prefix=tus.PREFIX,
        files_dir=str(uploads.files.folder),
        storage=store,
        tags=["uploads"],
        max_size=max(context.settings.max_photo_bytes, context.settings.max_cube_bytes),
        **hooks,
    )
    # The library's OPTIONS advertises extensions that are not served here.
    library.routes[:] = [
        route for route in library.routes if isinstance(route, APIRoute) and route.methods != {"OPTIONS"}
    ]
    for route in library.routes:
        if isinstance(route, APIRoute):
            _document(route)
    app.include_router(library, dependencies=[Depends(_verify_checksum)])
    app.add_middleware(tus.TusMiddleware)
