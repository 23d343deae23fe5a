"""Acquisitions: the photos and the cube of one specimen, under a pseudonym."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, cast, get_args

import sqlalchemy as sa
from fastapi import APIRouter, Query, Response
from pydantic import BaseModel, ConfigDict, Field, JsonValue, StringConstraints
from sqlalchemy.orm import Session

from specimap_core.pipeline.options import DEFAULTS, Dictionary
from specimap_infra.completeness import FileRow, files_of, missing_of
from specimap_infra.database import utc_now
from specimap_infra.deletion import check_removable
from specimap_infra.ids import new_id
from specimap_infra.job_schemas import EdgeMm
from specimap_infra.tables import Acquisition, Job, Upload
from specimap_service.acquisitions.capacity import locked_acquisition
from specimap_service.acquisitions.dependencies import JudgeDep, UnfinishedUploadsDep
from specimap_service.acquisitions.schemas import FileCounts, counts
from specimap_service.auth.access import in_sight, load, not_found, project_for_new
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import AcquisitionId
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import Context, audit
from specimap_service.idempotency import IdempotencyKey, Repeatable, repeated
from specimap_service.jobs.deletion import JobFiles
from specimap_service.paging import After, CreatedAfter, CreatedBefore, InProject, Limit, Page, Sort, page_of, paged

router = APIRouter(prefix="/v1", tags=["acquisitions"])
PSEUDONYM = r"^[A-Za-z0-9._-]{1,64}$"
Pseudonym = Annotated[str, StringConstraints(pattern=PSEUDONYM)]

# The contract has always listed the families in this order here.
DICTIONARIES_IN_CONTRACT: list[JsonValue] = [*sorted(get_args(Dictionary), key=lambda name: "APRILTAG" in name)]


class AcquisitionRequest(BaseModel):
    """A specimen and how its markers were made."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"example": {"specimen_id": "SP-2026-0117", "edge_mm": 6.8}}
    )

    specimen_id: Pseudonym = Field(description="Pseudonym of the specimen: letters, digits, dot, dash, underscore.")
    accession_number: Pseudonym | None = Field(None, description="Pseudonymous too, for finding it again.")
    dictionary: Dictionary = Field(
        cast(Dictionary, DEFAULTS.dictionary),
        description="ArUco dictionary of the marker cards.",
        json_schema_extra={"enum": DICTIONARIES_IN_CONTRACT},
    )
    edge_mm: EdgeMm = DEFAULTS.edge_mm
    notes: Annotated[str, StringConstraints(max_length=2000, pattern=r"^[^\x00]*$")] = Field(
        "", description="About the capture; no patient's data."
    )
    project: Pseudonym | None = Field(
        None, description="Id or name of its project, for good; needed by a person who has several."
    )

    def asked(self) -> dict[str, Any]:
        """Return what is compared when the request is sent again, as it was before there was a project in it."""
        return self.model_dump(mode="json", exclude={"project"} if self.project is None else None)


class AcquisitionView(BaseModel):
    """An acquisition, the files that have arrived, and those that are missing."""

    model_config = ConfigDict(title="Acquisition", from_attributes=True)

    id: str
    project_id: str = Field(description="Its project, and that of its files, jobs and results.")
    specimen_id: str
    accession_number: str | None
    dictionary: str
    edge_mm: float
    notes: str
    created_at: datetime.datetime
    created_by: str = Field(description="Id of the key that created it.")
    files: FileCounts
    ready: bool = Field(description="Whether a job can run.")
    missing: list[str] = Field(description="What is still needed, a sentence each.")


@router.post("/acquisitions", status_code=201, responses=repeated(AcquisitionView), operation_id="acquisitions.create")
def create_acquisition(
    context: Context,
    principal: Permitted,
    judge: JudgeDep,
    response: Response,
    wanted: AcquisitionRequest,
    idempotency_key: IdempotencyKey = None,
) -> AcquisitionView:
    """Create an acquisition; then upload its photos and its cube."""

    def make(session: Session, _: str) -> tuple[str, AcquisitionView]:
        row = Acquisition(
            id=new_id("acq"),
            project_id=project_for_new(session, principal, wanted.project),
            created_by=principal.key_id,
            created_at=utc_now(),
            **wanted.model_dump(exclude={"project"}),
        )
        session.add(row)
        audit(session, principal.key_id, "acquisition.create", row.id)
        session.flush()
        return row.id, _view(session, row)

    def again(session: Session, acquisition_id: str, _: str) -> AcquisitionView:
        return _view(session, load(session, principal, Acquisition, acquisition_id))

    request = Repeatable.of(principal, idempotency_key, "acquisitions.create", wanted.asked())
    view, new = request.once(context.database, make, again)
    judge.warm()
    response.status_code = 201 if new else 200
    return view


@router.get("/acquisitions", operation_id="acquisitions.list")
def list_acquisitions(
    context: Context,
    principal: Permitted,
    specimen_id: Annotated[str | None, Query(max_length=64, description="Only those of this specimen.")] = None,
    accession_number: Annotated[
        str | None, Query(max_length=64, description="Only those with this accession number.")
    ] = None,
    created_after: CreatedAfter = None,
    created_before: CreatedBefore = None,
    project: InProject = None,
    after: After = None,
    limit: Limit = 50,
    sort: Sort = "-created_at",
) -> Page[AcquisitionView]:
    """List acquisitions."""
    query = sa.select(Acquisition).where(in_sight(principal, Acquisition, project))
    for column, value in ((Acquisition.specimen_id, specimen_id), (Acquisition.accession_number, accession_number)):
        if value is not None:
            query = query.where(column == value)
    if created_after is not None:
        query = query.where(Acquisition.created_at >= created_after)
    if created_before is not None:
        query = query.where(Acquisition.created_at < created_before)
    query = paged(query, Acquisition.id, after, limit, sort)
    with context.database.session() as session:
        rows = list(session.scalars(query))
        views = _views(session, rows)
    return page_of(views, [row.id for row in rows], limit)


@router.get("/acquisitions/{acquisition_id}", operation_id="acquisitions.get")
def get_acquisition(context: Context, principal: Permitted, acquisition_id: AcquisitionId) -> AcquisitionView:
    """Return one acquisition."""
    with context.database.session() as session:
        row = session.get(Acquisition, acquisition_id)
        if row is None:
            raise not_found(acquisition_id)
        return _view(session, row)


@router.delete("/acquisitions/{acquisition_id}", status_code=204, operation_id="acquisitions.delete")
def delete_acquisition(
    context: Context,
    principal: Permitted,
    uploads: UnfinishedUploadsDep,
    clouds: CloudsDep,
    acquisition_id: AcquisitionId,
) -> None:
    """Delete an acquisition with its files, jobs, results, labels and exports. This cannot be undone."""
    with context.database.session() as session:
        row = locked_acquisition(session, acquisition_id)
        check_idle(session, acquisition_id)
        jobs = list(session.scalars(sa.select(Job.id).where(Job.acquisition_id == acquisition_id)))
        job_files = JobFiles.of(session, jobs)
        open_uploads = list(session.scalars(sa.select(Upload.id).where(Upload.acquisition_id == acquisition_id)))
        audit(session, principal.key_id, "acquisition.delete", acquisition_id, jobs=jobs)
        session.delete(row)
    for upload_id in open_uploads:
        uploads.remove(upload_id)
    context.storage.delete(f"acquisitions/{acquisition_id}")
    job_files.remove(context.storage, clouds)


def check_idle(session: Session, acquisition_id: str) -> None:
    """Raise JobConflictError while a job of the acquisition is queued or running, LegalHoldError while it is held."""
    check_removable(session, acquisition_id)


def _view(session: Session, row: Acquisition) -> AcquisitionView:
    return _views(session, [row])[0]


def _views(session: Session, rows: list[Acquisition]) -> list[AcquisitionView]:
    files = files_of(session, [row.id for row in rows])
    return [_with_files(row, files[row.id]) for row in rows]


def _with_files(row: Acquisition, files: list[FileRow]) -> AcquisitionView:
    lacking = missing_of(files)
    return AcquisitionView(
        id=row.id,
        project_id=row.project_id,
        specimen_id=row.specimen_id,
        accession_number=row.accession_number,
        dictionary=row.dictionary,
        edge_mm=row.edge_mm,
        notes=row.notes,
        created_at=row.created_at,
        created_by=row.created_by,
        files=counts(files),
        ready=not lacking,
        missing=lacking,
    )
