"""DICOM in: STOW-RS. Off unless ``SPECIMAP_STOW`` is on."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import JSONResponse

from specimap_core.atomic import disk_errors
from specimap_core.errors import NotFoundError
from specimap_hospital.outbox.workspaces import workspace
from specimap_service.acquisitions.dependencies import IntakeDep, JudgeDep
from specimap_service.auth.dependencies import Permitted
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import AppContext, Context
from specimap_service.errors import PayloadTooLargeError, RequestInvalidError
from specimap_service.hospital.intake import Intake, Taken
from specimap_service.hospital.related_parts import boundary_of, split_parts
from specimap_service.space import check_disks

router = APIRouter(prefix="/v1/dicomweb", tags=["dicomweb"])
ANSWER = "application/dicom+json"
BODY = {
    "requestBody": {
        "required": True,
        "content": {'multipart/related; type="application/dicom"': {"schema": {"type": "string", "format": "binary"}}},
    }
}


@router.post(
    "/studies",
    status_code=200,
    response_class=Response,
    responses={
        200: {"description": "All were taken", "content": {ANSWER: {}}},
        202: {"description": "Some were taken: `00081198` lists the others", "content": {ANSWER: {}}},
    },
    openapi_extra=BODY,
    operation_id="dicomweb.create",
)
async def receive_dicom(
    context: Context, principal: Permitted, judge: JudgeDep, turns: IntakeDep, clouds: CloudsDep, request: Request
) -> JSONResponse:
    """Take DICOM objects in (STOW-RS).

    A Segmentation of a result's top view becomes a label layer of that result, which takes the scope `label`. Photos
    (VL Photographic Image, Secondary Capture) of a study become an acquisition, which takes `upload`. All else is
    refused: with 409 where nothing was taken, in the form of 202.
    """
    if context.settings.stow == "off":
        raise NotFoundError(
            "This service takes no DICOM objects.", advice="Ask whoever runs it to set SPECIMAP_STOW to on."
        )
    boundary = boundary_of(request.headers.get("content-type", ""))
    _check_length(context, request)
    with workspace(context.settings.scratch) as folder:
        body = folder / "body"
        await _receive(context, request, body)
        intake = Intake(context, judge, clouds, principal)
        results: list[Taken] = []
        parts = split_parts(body, boundary, folder)
        while (part := await run_in_threadpool(partial(next, parts, None))) is not None:
            take = partial(intake.take, part, folder / f"of-{part.stem}")
            # As with forms: the first may be refused, those after it wait.
            run = turns.go_on if results else turns.run
            results.append(await run(principal.key_id, take))
            part.unlink()
    if not results:
        raise RequestInvalidError("The body holds no object.", advice="Send one DICOM object in each part.")
    return JSONResponse(_answer(results), _status(results), media_type=ANSWER)


def _status(results: list[Taken]) -> int:
    failed = sum(result.failure is not None for result in results)
    return 200 if not failed else 409 if failed == len(results) else 202


def _check_length(context: AppContext, request: Request) -> None:
    length = request.headers.get("content-length", "0")
    if length.isdecimal() and int(length) > context.settings.most_dicom_bytes:
        raise _too_large(context)
    check_disks(context, int(length) if length.isdecimal() else 0)


async def _receive(context: AppContext, request: Request, body: Path) -> None:
    """Write the body to the disk as it arrives."""
    size = 0
    with disk_errors(body), open(body, "wb") as file:
        async for piece in request.stream():
            size += len(piece)
            if size > context.settings.most_dicom_bytes:
                raise _too_large(context)
            await run_in_threadpool(file.write, piece)


def _too_large(context: AppContext) -> PayloadTooLargeError:
    limit = context.settings.most_dicom_bytes
    return PayloadTooLargeError(
        f"The body has more than {limit} bytes.", advice="Send fewer objects at a time.", limit_bytes=limit
    )


def _answer(results: list[Taken]) -> dict[str, Any]:
    """Store Instances Response Module, as DICOM JSON."""
    taken = [_item(result) for result in results if result.failure is None]
    failed = [
        {**_item(result), "00081197": {"vr": "US", "Value": [result.failure]}}
        for result in results
        if result.failure is not None
    ]
    answer: dict[str, Any] = {}
    if failed:
        answer["00081198"] = {"vr": "SQ", "Value": failed}
    if taken:
        answer["00081199"] = {"vr": "SQ", "Value": taken}
    return answer


def _item(result: Taken) -> dict[str, Any]:
    named = {"00081150": result.sop_class_uid, "00081155": result.sop_instance_uid}
    return {tag: {"vr": "UI", "Value": [uid]} for tag, uid in named.items() if uid}
