"""Resumable uploads by the tus protocol 1.0 (tus.io), and what became of one."""

from __future__ import annotations

import asyncio
import base64
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from typing import Annotated, Any, Literal, cast

from fastapi import APIRouter, Depends, FastAPI, Path, Request, Response
from fastapi.routing import APIRoute
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException
from tuspyserver import create_tus_router

from specimap_core.errors import SpecimapError
from specimap_infra.logs import logger
from specimap_infra.tables import StoredFile, Upload
from specimap_service.acquisitions.schemas import File
from specimap_service.auth.keys import Uploader
from specimap_service.context import AppContext, Context
from specimap_service.errors import RequestInvalidError
from specimap_service.uploads import lifecycle, tus
from specimap_service.uploads.files import UploadFiles
from specimap_service.uploads.tus_store import UploadStore

router = APIRouter(prefix="/v1", tags=["uploads"])
UploadId = Annotated[str, Path(pattern=r"^up_[0-9a-z]{26}$", examples=["up_01k0000000000000000000000"])]
SWEEP_SECONDS = 300.0
State = Literal["open", "finished", "failed", "expired", "terminated"]
OCTETS = "application/offset+octet-stream"


class Failure(BaseModel):
    """Why an upload came to nothing."""

    code: str
    message: str
    advice: str


class UploadResult(BaseModel):
    """How an upload stands, and the file that it became."""

    id: str
    state: State
    offset: int = Field(description="Bytes that have arrived.")
    size: int = Field(description="Bytes announced.")
    file: File | None = Field(description="Once finished: the stored file with its judgement; null if deleted since.")
    error: Failure | None = Field(description="Where it failed: why.")


def upload_files(request: Request) -> UploadFiles:
    """The app's folder of uploads."""
    files: UploadFiles = request.app.state.upload_files
    return files


Files = Annotated[UploadFiles, Depends(upload_files)]


@router.get("/uploads/{upload_id}/result")
def get_result(context: Context, principal: Uploader, files: Files, upload_id: UploadId) -> UploadResult:
    """How an upload stands. For a finished one the file, with the judgement and an advice where it is to be retaken."""
    upload = lifecycle.current(context, files, upload_id, principal)
    stored = _stored(context, upload)
    return UploadResult(
        id=upload.id,
        state=cast(State, upload.state),
        size=upload.size,
        offset=upload.size if upload.state in ("finished", "failed") else files.size(upload.id) or 0,
        file=None if stored is None else File.model_validate(stored),
        error=None if upload.error is None else Failure.model_validate(upload.error),
    )


@router.options("/uploads", status_code=204, response_class=Response)
def get_abilities(context: Context, principal: Uploader) -> Response:
    """What this tus server can do: the `Tus-…` headers of the answer."""
    settings = context.settings
    headers = {
        "Tus-Version": tus.VERSION,
        "Tus-Extension": tus.EXTENSIONS,
        "Tus-Max-Size": str(max(settings.max_photo_bytes, settings.max_cube_bytes)),
        "Tus-Checksum-Algorithm": ",".join(tus.ALGORITHMS),
    }
    return Response(status_code=204, headers=headers)


def _stored(context: AppContext, upload: Upload) -> StoredFile | None:
    if upload.file_id is None:
        return None
    with context.database.session() as session:
        return session.get(StoredFile, upload.file_id)


# ---- before the library sees a request ----------------------------------------------------------------


def _admitted(request: Request, context: Context, principal: Uploader, files: Files) -> None:
    """Check all that can be checked before the body is read: the library checks most of it afterwards."""
    exchange, headers = tus.exchange(), request.headers
    exchange.principal = principal
    if headers.get("tus-resumable") != tus.VERSION:
        raise HTTPException(412, f"Tus-Resumable must be {tus.VERSION}")
    if request.method == "POST":
        _check_creation(request)
        return
    upload = exchange.upload = lifecycle.current(context, files, request.path_params["uuid"], principal)
    lifecycle.check_alive(upload)
    _tell(context, upload, exchange)
    if request.method == "HEAD":
        given = {"acquisition": upload.acquisition_id, "role": upload.role, "filename": upload.name}
        exchange.headers["Upload-Metadata"] = ",".join(f"{key} {_base64(value)}" for key, value in given.items())
    if request.method == "PATCH":
        _check_chunk(request, upload, files, exchange)


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


def _check_chunk(request: Request, upload: Upload, files: UploadFiles, exchange: tus.Exchange) -> None:
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


async def _verified(request: Request, files: Files, _: Annotated[None, Depends(_admitted)]) -> None:
    exchange = tus.exchange()
    if exchange.checksum is not None and exchange.upload is not None:
        await exchange.verify(exchange.upload.size, files.folder)


# ---- the library's hooks ------------------------------------------------------------------------------


def _creating(context: Context, files: Files) -> Callable[[dict[str, str], dict[str, Any]], Awaitable[None]]:
    async def create(metadata: dict[str, str], info: dict[str, Any]) -> None:
        exchange = tus.exchange()
        assert exchange.principal is not None
        upload = await asyncio.to_thread(lifecycle.create, context, files, exchange.principal, metadata, info["size"])
        exchange.upload = upload
        exchange.headers["Location"] = f"{context.settings.public_url.rstrip('/')}{tus.PREFIX}/{upload.id}"
        exchange.headers["Upload-Expires"] = tus.http_date(upload)

    return create


def _naming() -> Callable[[dict[str, str]], dict[str, str]]:
    def name(metadata: dict[str, str]) -> dict[str, str]:
        upload = tus.exchange().upload
        return {} if upload is None else {"uid": upload.id}

    return name


def _completing(context: Context, files: Files) -> Callable[[str, dict[str, str]], Awaitable[None]]:
    async def complete(upload_id: str, metadata: dict[str, str]) -> None:
        exchange = tus.exchange()
        if exchange.upload is not None and exchange.upload.state == "open":
            exchange.upload = await asyncio.to_thread(lifecycle.finish, context, files, upload_id)
            await asyncio.to_thread(_tell, context, exchange.upload, exchange)

    return complete


def _tell(context: AppContext, upload: Upload, exchange: tus.Exchange) -> None:
    """Say in the answer's headers what became of a finished upload."""
    if upload.state == "failed":
        exchange.headers["Specimap-Verdict"] = "refused"
    stored = _stored(context, upload)
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
        "summary": "Create an upload",
        "description": "`Upload-Metadata`: `acquisition` (its id), `role` (photo, cube, white, dark), `filename`, each "
        "with its value in base64. The answer's `Location` takes the bytes. The body is empty.",
        "headers": ("Location", "Upload-Expires"),
    },
    "HEAD": {
        "summary": "Ask how much has arrived",
        "description": "`Upload-Offset` says where to go on.",
        "headers": ("Upload-Offset", "Upload-Length", "Upload-Metadata"),
    },
    "PATCH": {
        "summary": "Send bytes",
        "description": "From `Upload-Offset` on; with `Upload-Checksum` (sha1, sha256 or md5, and the digest in "
        "base64) all or nothing: 460 where it differs. The answer to the last byte comes when the file has been "
        "judged, and carries `Specimap-File` and `Specimap-Verdict`; `GET …/result` tells more.",
        "headers": ("Upload-Offset", "Upload-Expires", "Specimap-File", "Specimap-Verdict"),
    },
    "DELETE": {"summary": "End an upload", "description": "Its bytes are forgotten.", "headers": ()},
}


def _document(route: APIRoute) -> None:
    method = next(iter(route.methods or ()))
    about = DOCUMENTED[method]
    status = str(route.status_code)
    route.summary, route.description = about["summary"], about["description"]
    route.response_class = Response
    # POST to an address that ends in a slash, as some clients do, is the same.
    route.include_in_schema = not route.path.endswith("/")
    answer = {name: {"schema": {"type": "string"}} for name in about["headers"]}
    if method == "PATCH":
        route.openapi_extra = _BODY
    route.responses = {status: {"description": about["summary"], "headers": answer}}


def mount(app: FastAPI, context: AppContext) -> None:
    """Add the tus routes to the app."""
    files = app.state.upload_files = UploadFiles(context.settings.scratch / "uploads")
    store = UploadStore(
        files,
        received=context.metrics.uploaded.inc,
        delete=lambda upload_id, principal: lifecycle.terminate(context, files, upload_id, principal),
    )
    # Its annotations leave out that hooks may be coroutines and return something.
    hooks: dict[str, Any] = {
        "pre_create_dep": _creating,
        "upload_complete_dep": _completing,
        "file_dep": _naming,
    }
    library = create_tus_router(
        prefix=tus.PREFIX,
        files_dir=str(files.folder),
        storage=store,
        tags=["uploads"],
        max_size=max(context.settings.max_photo_bytes, context.settings.max_cube_bytes),
        **hooks,
    )
    # Its OPTIONS advertises extensions that are not served here.
    library.routes[:] = [
        route for route in library.routes if isinstance(route, APIRoute) and route.methods != {"OPTIONS"}
    ]
    for route in library.routes:
        if isinstance(route, APIRoute):
            _document(route)
    app.include_router(library, dependencies=[Depends(_verified)])
    app.add_middleware(tus.Wire)


@asynccontextmanager
async def sweeping(app: FastAPI, context: AppContext) -> AsyncIterator[None]:
    """Drop expired uploads every few minutes while the block runs."""

    async def forever() -> None:
        while True:
            try:
                await asyncio.to_thread(lifecycle.sweep, context, app.state.upload_files)
            except (SpecimapError, OSError):
                logger().exception("sweeping of uploads failed")
            await asyncio.sleep(SWEEP_SECONDS)

    task = asyncio.create_task(forever())
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
