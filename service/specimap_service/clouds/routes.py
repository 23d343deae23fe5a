"""``/v1/clouds``: the finished results."""

from __future__ import annotations

import datetime
from typing import Annotated

import numpy as np
import sqlalchemy as sa
from fastapi import APIRouter, Query, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from specimap_core.errors import NotFoundError
from specimap_core.report.cameras import Cameras
from specimap_infra.tables import Acquisition, CloudRow, Job
from specimap_service.auth.access import in_sight
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import CloudId
from specimap_service.byte_ranges import ranged_response
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import Context
from specimap_service.errors import CamerasMissingError
from specimap_service.paging import After, InProject, Limit, Page, Sort, page_of, paged

router = APIRouter(prefix="/v1", tags=["clouds"])


class CloudSummary(BaseModel):
    """A finished cloud."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    job_id: str
    acquisition_id: str
    points: int
    bands: int
    size: int = Field(description="Bytes of the whole result as stored.")
    created_at: datetime.datetime


class CloudAnswer(CloudSummary):
    """A finished cloud with the metadata of its arrays, and links to everything else."""

    model_config = ConfigDict(title="Cloud")

    quantity: str = Field(description="Quantity of decoded spectra: `reflectance`, or `counts`.")
    wavelength_nm: list[float | None] = Field(description="One for each band; null where unknown.")
    bad_bands: list[int] = Field(description="Bands that are useless according to the cube's file or its noise.")
    low: list[float] = Field(description="Least x, y, z of the points, mm, marker frame.")
    high: list[float]
    labels: list[str]
    links: dict[str, str]


@router.get("/clouds", operation_id="clouds.list")
def list_clouds(
    context: Context,
    principal: Permitted,
    acquisition_id: Annotated[str | None, Query(max_length=64, description="Only those of this acquisition.")] = None,
    specimen_id: Annotated[str | None, Query(max_length=200, description="Only those of this specimen.")] = None,
    project: InProject = None,
    after: After = None,
    limit: Limit = 100,
    sort: Sort = "-created_at",
) -> Page[CloudSummary]:
    """List finished clouds."""
    query = sa.select(CloudRow).join(Job, Job.id == CloudRow.job_id).where(Job.state == "succeeded")
    query = query.where(in_sight(principal, CloudRow, project))
    if acquisition_id is not None:
        query = query.where(CloudRow.acquisition_id == acquisition_id)
    if specimen_id is not None:
        query = query.join(Acquisition, Acquisition.id == CloudRow.acquisition_id)
        query = query.where(Acquisition.specimen_id == specimen_id)
    query = paged(query, CloudRow.id, after, limit, sort).options(sa.orm.defer(CloudRow.report))
    with context.database.session() as session:
        rows = list(session.scalars(query))
    return page_of([CloudSummary.model_validate(row) for row in rows], [row.id for row in rows], limit)


@router.get("/clouds/{cloud_id}", operation_id="clouds.get")
def show_cloud(principal: Permitted, clouds: CloudsDep, cloud_id: CloudId) -> CloudAnswer:
    """Return one cloud."""
    with clouds.reading(cloud_id) as (record, cloud):
        boxes, here = cloud.chunk_aabb, f"/v1/clouds/{cloud_id}"
        return CloudAnswer(
            **CloudSummary.model_validate(record).model_dump(),
            quantity=cloud.quantity,
            wavelength_nm=[float(nm) if np.isfinite(nm) else None for nm in cloud.wavelengths_nm],
            bad_bands=np.flatnonzero(cloud.bad_bands).tolist(),
            low=boxes[:, :3].min(0).tolist(),
            high=boxes[:, 3:].max(0).tolist(),
            labels=list(record.labels),
            links={
                "report": f"/v1/jobs/{record.job_id}/report",
                "zarr": f"{here}/zarr",
                "spectra": f"{here}/spectra",
                "previews": f"{here}/previews/rgb.png",
                "labels": f"{here}/labels",
                "exports": f"{here}/exports",
                "mesh": f"{here}/exports/mesh-ply",
                "corners": f"{here}/corners",
                "cameras": f"{here}/cameras",
            },
        )


@router.get(
    "/clouds/{cloud_id}/corners",
    response_class=Response,
    responses={200: {"content": {"application/json": {}}}},
    operation_id="clouds.get_corners",
)
def get_corners(
    context: Context, principal: Permitted, clouds: CloudsDep, request: Request, cloud_id: CloudId
) -> Response:
    """Return the markers' corners: `{"<id>": [[x, y, z] * 4]}`, mm, in the marker frame."""
    record = clouds.record(cloud_id)
    return ranged_response(request, context.storage, f"{record.prefix}/corners.json", "application/json")


@router.get(
    "/clouds/{cloud_id}/cameras",
    response_class=Response,
    responses={200: {"model": Cameras}},
    operation_id="clouds.get_cameras",
)
def get_cameras(
    context: Context, principal: Permitted, clouds: CloudsDep, request: Request, cloud_id: CloudId
) -> Response:
    """Return the cameras of the photos and of the cube, in the marker frame, mm."""
    record = clouds.record(cloud_id)
    try:
        return ranged_response(request, context.storage, f"{record.prefix}/cameras.json", "application/json")
    except NotFoundError as error:
        raise CamerasMissingError(
            "The result comes from a version that kept no cameras.",
            advice=f"Repeat the job with POST /v1/jobs/{record.job_id}/rerun: its new result has them.",
        ) from error
