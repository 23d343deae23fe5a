"""Routes that the tus library does not serve: the result of an upload, and what this server supports."""

from __future__ import annotations

from typing import Literal, cast

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field

from specimap_infra.tables import Upload
from specimap_service.acquisitions.schemas import File
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import UploadId
from specimap_service.context import Context
from specimap_service.uploads import tus
from specimap_service.uploads.dependencies import UploadsDep
from specimap_service.uploads.lifecycle import Uploads

router = APIRouter(prefix="/v1", tags=["uploads"])
State = Literal["open", "finished", "failed", "expired", "terminated"]


class Failure(BaseModel):
    """The reason why an upload failed."""

    model_config = ConfigDict(title="UploadFailure")

    code: str
    message: str
    advice: str


class UploadResult(BaseModel):
    """The state of an upload, and the file that it became."""

    id: str
    state: State
    offset: int = Field(description="Bytes that have arrived.")
    size: int = Field(description="Bytes announced.")
    file: File | None = Field(description="Once finished: the stored file with its judgement; null if deleted since.")
    error: Failure | None = Field(description="The reason, where it failed.")


@router.get("/uploads/{upload_id}/result", operation_id="uploads.get_result")
async def get_result(request: Request, principal: Permitted, uploads: UploadsDep, upload_id: UploadId) -> UploadResult:
    """Return the state of an upload; for a finished one its file, with the judgement and advice on retaking it."""
    upload = await uploads.current(upload_id, principal, request.receive)
    return await run_in_threadpool(_result, uploads, upload)


def _result(uploads: Uploads, upload: Upload) -> UploadResult:
    upload = uploads.renewed(upload)
    stored = uploads.stored_file(upload)
    return UploadResult(
        id=upload.id,
        state=cast(State, upload.state),
        size=upload.size,
        offset=upload.size if upload.state in ("finished", "failed") else uploads.files.size(upload.id) or 0,
        file=None if stored is None else File.model_validate(stored),
        error=None if upload.error is None else Failure.model_validate(upload.error),
    )


@router.options("/uploads", status_code=204, response_class=Response, operation_id="uploads.get_options")
def get_abilities(context: Context, principal: Permitted) -> Response:
    """Return what this tus server supports, in the `Tus-…` headers of the answer."""
    settings = context.settings
    headers = {
        "Tus-Version": tus.VERSION,
        "Tus-Extension": tus.EXTENSIONS,
        "Tus-Max-Size": str(max(settings.max_photo_bytes, settings.max_cube_bytes)),
        "Tus-Checksum-Algorithm": ",".join(tus.ALGORITHMS),
    }
    return Response(status_code=204, headers=headers)
