"""The study context of an acquisition: the order, patient and specimen that its DICOM objects belong to.

Who may read results may not read whose they are: all of this takes the scope ``upload``.
"""

from __future__ import annotations

import datetime

from fastapi import APIRouter, Response
from pydantic import BaseModel, Field

from specimap_core.errors import NotFoundError
from specimap_infra.deletion import check_not_held
from specimap_infra.studies import find_study, put_study, study_keys
from specimap_infra.study_context import StudyContext
from specimap_infra.tables import SealedStudy
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import AcquisitionId
from specimap_service.context import Context, audit

router = APIRouter(prefix="/v1", tags=["studies"])


class Study(BaseModel):
    """The study context of an acquisition."""

    acquisition_id: str
    study: StudyContext
    version: int = Field(description="Counts the changes.")
    updated_at: datetime.datetime
    updated_by: str = Field(description="Id of the key that changed it last.")


@router.put("/acquisitions/{acquisition_id}/study", operation_id="studies.put")
def put_study_context(
    context: Context, principal: Permitted, response: Response, acquisition_id: AcquisitionId, wanted: StudyContext
) -> Study:
    """Say which order, patient and specimen an acquisition belongs to; replaces what was said before.

    The answer to an order lookup holds one as `study`. Where an archive is set, results are sent again with it.
    """
    keys = study_keys(context.settings)
    response.headers["Cache-Control"] = "no-store"
    with context.database.session() as session:
        found = find_study(session, keys, acquisition_id)
        if found is not None and found.context != wanted:
            check_not_held(session, acquisition_id)
        row = put_study(session, keys, acquisition_id, wanted, principal.key_id)
        audit(session, principal.key_id, "study.put", acquisition_id, version=row.version)
        return _view(row, wanted)


@router.get("/acquisitions/{acquisition_id}/study", operation_id="studies.get")
def get_study_context(
    context: Context, principal: Permitted, response: Response, acquisition_id: AcquisitionId
) -> Study:
    """Return the study context. That somebody read it is kept in the audit trail."""
    keys = study_keys(context.settings)
    response.headers["Cache-Control"] = "no-store"
    with context.database.session() as session:
        found = find_study(session, keys, acquisition_id)
        if found is None:
            raise _no_study(acquisition_id)
        audit(session, principal.key_id, "study.read", acquisition_id, version=found.row.version)
        return _view(found.row, found.context)


@router.delete("/acquisitions/{acquisition_id}/study", status_code=204, operation_id="studies.delete")
def delete_study_context(context: Context, principal: Permitted, acquisition_id: AcquisitionId) -> None:
    """Remove the study context. What an archive has received stays there."""
    with context.database.session() as session:
        row = session.get(SealedStudy, acquisition_id, with_for_update=True)
        if row is None:
            raise _no_study(acquisition_id)
        check_not_held(session, acquisition_id)
        session.delete(row)
        audit(session, principal.key_id, "study.delete", acquisition_id)


def _view(row: SealedStudy, study: StudyContext) -> Study:
    return Study(
        acquisition_id=row.acquisition_id,
        study=study,
        version=row.version,
        updated_at=row.updated_at,
        updated_by=row.updated_by,
    )


def _no_study(acquisition_id: str) -> NotFoundError:
    return NotFoundError(
        f"Acquisition {acquisition_id} has no study context.",
        advice=f"PUT /v1/acquisitions/{acquisition_id}/study gives it one.",
    )
