"""From where an acquisition's photos were taken, and where one is missing."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import sqlalchemy as sa
from fastapi import APIRouter, Request
from fastapi.concurrency import run_in_threadpool

from specimap_core.screening.dome import dome_of
from specimap_core.screening.viewpoints import MarkersSeen, Views, measured_views
from specimap_infra.tables import Acquisition, StoredFile
from specimap_service.acquisitions.dependencies import PlacingDep
from specimap_service.acquisitions.schemas import PhotoJudgement
from specimap_service.acquisitions.viewpoint_schemas import (
    DomeCell,
    MarkerPlace,
    PhotoViewpoint,
    UnplacedPhoto,
    Viewpoints,
)
from specimap_service.auth.access import not_found
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import AcquisitionId
from specimap_service.context import AppContext, Context

router = APIRouter(prefix="/v1", tags=["acquisitions"])
KEPT = 64
"""Answers that are kept: a page asks again and again while nothing changes."""

Square = tuple[int, tuple[tuple[float, float], ...]]
Shown = tuple[tuple[tuple[int, int], tuple[Square, ...]], ...]
"""Of each photo its size and its markers, as something that can be looked up."""


@router.get("/acquisitions/{acquisition_id}/viewpoints", operation_id="acquisitions.get_viewpoints")
async def get_viewpoints(
    context: Context, principal: Permitted, placing: PlacingDep, request: Request, acquisition_id: AcquisitionId
) -> Viewpoints:
    """Tell from where each accepted photo was taken, as its markers show, and where to stand next."""
    edge_mm, photos = await run_in_threadpool(_photos, context, acquisition_id)
    judged = [PhotoJudgement.model_validate(photo.judgement) for photo in photos]
    shown = tuple(_shown(judgement) for judgement in judged)
    views = await placing.run_while(request.receive, principal.key_id, lambda: _views(shown, edge_mm))
    good = [view for k, view in views.viewpoints.items() if judged[k].verdict == "accepted"]
    dome = dome_of(good)
    return Viewpoints(
        photos=[
            PhotoViewpoint(
                file_id=photos[k].id,
                label=photos[k].label,
                azimuth_deg=round(view.azimuth_deg, 2),
                elevation_deg=round(view.elevation_deg, 2),
                distance_mm=round(view.distance_mm, 1),
            )
            for k, view in views.viewpoints.items()
        ],
        unplaced=[
            UnplacedPhoto(file_id=photo.id, label=photo.label, markers=len(judged[k].markers))
            for k, photo in enumerate(photos)
            if k not in views.viewpoints
        ],
        markers=[
            MarkerPlace(id=marker, corners_mm=np.round(corners[:, :2], 2).tolist())
            for marker, corners in views.markers.items()
        ],
        cells=[DomeCell.model_validate(cell) for cell in dome.cells],
        covered=round(dome.covered, 4),
        next=None if dome.next is None else DomeCell.model_validate(dome.next),
        enough=dome.enough,
    )


def _photos(context: AppContext, acquisition_id: str) -> tuple[float, list[StoredFile]]:
    query = sa.select(StoredFile).where(
        StoredFile.acquisition_id == acquisition_id, StoredFile.role == "photo", StoredFile.state == "accepted"
    )
    with context.database.session() as session:
        acquisition = session.get(Acquisition, acquisition_id)
        if acquisition is None:
            raise not_found(acquisition_id)
        return acquisition.edge_mm, list(session.scalars(query.order_by(StoredFile.id)))


def _shown(judgement: PhotoJudgement) -> tuple[tuple[int, int], tuple[Square, ...]]:
    size = (judgement.width or 0, judgement.height or 0)
    squares = tuple((marker.id, tuple(marker.corners)) for marker in judgement.markers) if min(size) > 0 else ()
    return size, squares


@lru_cache(maxsize=KEPT)
def _views(shown: Shown, edge_mm: float) -> Views:
    photos = [
        MarkersSeen(size, {marker: np.array(corners, float) for marker, corners in squares}) for size, squares in shown
    ]
    return measured_views(photos, edge_mm)
