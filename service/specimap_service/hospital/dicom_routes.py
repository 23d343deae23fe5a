"""DICOM objects of a result, and their way to the archive."""

from __future__ import annotations

import datetime
import os
from collections import defaultdict
from collections.abc import Iterator
from typing import Annotated, Any, BinaryIO, Literal

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask

from specimap_hospital.outbox.making import make_objects
from specimap_hospital.outbox.rows import request_set
from specimap_hospital.outbox.workspaces import workspace
from specimap_infra import tables
from specimap_infra.database import utc_now
from specimap_infra.errors import ArchiveMissingError
from specimap_infra.studies import study_keys
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.keys import Principal
from specimap_service.auth.object_ids import CloudId
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import AppContext, Context, audit
from specimap_service.hospital.dependencies import MakingDep
from specimap_service.paging import After, MaybeLimit, Sort, listed, paged

router = APIRouter(prefix="/v1/clouds/{cloud_id}", tags=["dicom"])
DeliveryState = Literal["waiting", "sent", "committed", "failed"]
MOST_BANDS = 32
ARCHIVE = "dicom.zip"


class DicomRequest(BaseModel):
    """Which objects are sent: by default the first set. With bands or a label layer, objects beside it."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"bands": [12, 45]}})

    bands: Annotated[list[Annotated[int, Field(ge=0, le=65535)]], Field(max_length=MOST_BANDS)] = Field(
        [], description="Bands of the cube, by index, as a Parametric Map."
    )
    label: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._-]{1,64}$")] | None = Field(
        None, description="A label layer: of classes, as a Segmentation; of probabilities, as a Parametric Map."
    )
    columns: Annotated[list[Annotated[int, Field(ge=0, le=65535)]], Field(max_length=MOST_BANDS)] = Field(
        [], description="Of a layer of probabilities: which classes, by index; without, all."
    )
    again: bool = Field(False, description="Send also what the archive has; without, what failed alone.")

    @model_validator(mode="after")
    def _one_kind(self) -> DicomRequest:
        if self.bands and self.label is not None:
            raise ValueError("give bands or a label layer, not both")
        if self.columns and self.label is None:
            raise ValueError("columns are those of a label layer")
        return self

    def options(self) -> dict[str, Any]:
        """As a set keeps them."""
        given = {"bands": self.bands, "label": self.label, "columns": self.columns}
        return {name: value for name, value in given.items() if value}


class DicomInstance(BaseModel):
    """One object of a set."""

    model_config = ConfigDict(from_attributes=True)

    sop_instance_uid: str
    sop_class_uid: str
    kind: str = Field(description="What it is: `photo`, `top_view`, `measurements`, ...")
    size: int = Field(description="Bytes.")
    state: DeliveryState
    reason: str | None = Field(description="Why it waits or failed: a code that docs/pacs.md explains.")
    sent_at: datetime.datetime | None


class DicomSet(BaseModel):
    """Objects that are sent together, and how far that has come."""

    id: str
    cloud_id: str
    objects: dict[str, Any] = Field(description="What was asked for; empty for the first set.")
    state: DeliveryState = Field(description="`sent`: the archive has all; `committed`: it said that it keeps them.")
    attempts: int
    reason: str | None = Field(description="Why the last attempt did not end well: a code.")
    next_at: datetime.datetime | None = Field(description="While it waits: when the next attempt is due.")
    created_at: datetime.datetime
    instances: list[DicomInstance] = Field(description="Empty until the objects were made for the first time.")


@router.get("/dicom", operation_id="dicom.list")
def list_dicom(
    context: Context,
    principal: Permitted,
    clouds: CloudsDep,
    request: Request,
    response: Response,
    cloud_id: CloudId,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "created_at",
) -> list[DicomSet]:
    """List the sets of DICOM objects of a result, with the state of each object. It says nothing of the patient."""
    clouds.record(cloud_id)
    query = sa.select(tables.DicomSet).where(tables.DicomSet.cloud_id == cloud_id)
    with context.database.session() as session:
        rows = list(session.scalars(paged(query, tables.DicomSet.id, after, limit, sort)))
        views = _views(session, rows)
    return listed(request, response, views, [view.id for view in views], limit)


@router.post("/dicom", status_code=202, operation_id="dicom.create")
def send_dicom(
    context: Context, principal: Permitted, clouds: CloudsDep, cloud_id: CloudId, wanted: DicomRequest | None = None
) -> DicomSet:
    """Have DICOM objects of a result made and sent to the archive; asked again, what failed is tried again.

    The acquisition needs a study context. Where the archive has an object of the same UID, the new one takes its place.
    """
    clouds.record(cloud_id)
    wanted = wanted or DicomRequest()  # type: ignore[call-arg]
    if not context.settings.sends_dicom:
        raise ArchiveMissingError(
            "No archive to send to is set.", advice="Ask whoever runs the service to set SPECIMAP_PACS_URL."
        )
    study_keys(context.settings)
    with context.database.session() as session:
        row = request_set(session, cloud_id, wanted.options(), principal.key_id, utc_now(), again=wanted.again)
        audit(session, principal.key_id, "dicom.request", cloud_id, set=row.id, again=wanted.again)
        (view,) = _views(session, [row])
    return view


@router.get(
    "/dicom.zip",
    response_class=Response,
    responses={200: {"content": {"application/zip": {"schema": {"type": "string", "format": "binary"}}}}},
    operation_id="dicom.get_archive",
)
async def get_archive(
    context: Context, principal: Permitted, clouds: CloudsDep, making: MakingDep, request: Request, cloud_id: CloudId
) -> StreamingResponse:
    """Return the first set of DICOM objects as a ZIP with a DICOMDIR, made anew for each request.

    It holds what the study context says of the patient, so nothing of it is kept.
    """
    await run_in_threadpool(clouds.record, cloud_id)
    file = await making.run_while(request.receive, principal.key_id, lambda: _archive(context, principal, cloud_id))
    headers = {
        "Content-Length": str(os.fstat(file.fileno()).st_size),
        "Content-Disposition": f'attachment; filename="{cloud_id}-dicom.zip"',
        "Cache-Control": "no-store",
    }
    # Closed also where nobody reads it: the answer to HEAD has no body.
    closing = BackgroundTask(file.close)
    return StreamingResponse(_pieces(file), media_type="application/zip", headers=headers, background=closing)


def _archive(context: AppContext, principal: Principal, cloud_id: str) -> BinaryIO:
    """Make the archive; open, and removed already, so that it goes with whoever reads it."""
    with workspace(context.settings.scratch) as folder:
        make_objects(context.database, context.storage, context.settings, cloud_id, {}, folder, archive=ARCHIVE)
        with context.database.session() as session:
            audit(session, principal.key_id, "dicom.download", cloud_id)
        return open(folder / "objects" / ARCHIVE, "rb")


def _pieces(file: BinaryIO) -> Iterator[bytes]:
    with file:
        while piece := file.read(1 << 18):
            yield piece


def _views(session: Session, rows: list[tables.DicomSet]) -> list[DicomSet]:
    instances: dict[str, list[DicomInstance]] = defaultdict(list)
    of_sets = tables.DicomInstance.set_id.in_([row.id for row in rows])
    for found in session.scalars(sa.select(tables.DicomInstance).where(of_sets).order_by(tables.DicomInstance.number)):
        instances[found.set_id].append(DicomInstance.model_validate(found))
    return [
        DicomSet(
            id=row.id,
            cloud_id=row.cloud_id,
            objects=row.options,
            state=row.state,  # type: ignore[arg-type]
            attempts=row.attempts,
            reason=row.reason,
            next_at=row.next_at if row.state == "waiting" else None,
            created_at=row.created_at,
            instances=instances[row.id],
        )
        for row in rows
    ]
