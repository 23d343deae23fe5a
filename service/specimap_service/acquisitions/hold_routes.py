"""Legal holds: an acquisition that nobody deletes, whatever rule or person asks."""

from __future__ import annotations

import datetime
from typing import Annotated

from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Field, StringConstraints

from specimap_core.errors import NotFoundError
from specimap_infra.database import utc_now
from specimap_infra.tables import LegalHold
from specimap_service.acquisitions.capacity import locked_acquisition
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import AcquisitionId
from specimap_service.context import Context, audit

router = APIRouter(prefix="/v1/acquisitions/{acquisition_id}/hold", tags=["holds"])


class HoldRequest(BaseModel):
    """Why an acquisition is held."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"reason": "litigation-2026-14"}})

    reason: Annotated[str, StringConstraints(pattern=r"^[a-z0-9._-]{1,40}$")] = Field(
        description="A code of the hospital's; no text about a person."
    )


class Hold(BaseModel):
    """A legal hold of an acquisition."""

    model_config = ConfigDict(from_attributes=True)

    acquisition_id: str
    reason: str
    created_at: datetime.datetime
    created_by: str


@router.put("", responses={201: {"model": Hold, "description": "Held from now on"}}, operation_id="holds.put")
def put_hold(
    context: Context, principal: Permitted, response: Response, acquisition_id: AcquisitionId, wanted: HoldRequest
) -> Hold:
    """Keep an acquisition, its files, jobs, results and labels from being deleted; again, to change the reason."""
    with context.database.session() as session:
        locked_acquisition(session, acquisition_id)
        row = session.get(LegalHold, acquisition_id)
        if row is None:
            response.status_code = 201
            row = LegalHold(acquisition_id=acquisition_id, created_at=utc_now(), created_by=principal.key_id)
            session.add(row)
        row.reason = wanted.reason
        audit(session, principal.key_id, "hold.put", acquisition_id, reason=wanted.reason)
        session.flush()
        return Hold.model_validate(row)


@router.get("", operation_id="holds.get")
def get_hold(context: Context, principal: Permitted, acquisition_id: AcquisitionId) -> Hold:
    """Return the hold of an acquisition."""
    with context.database.session() as session:
        row = session.get(LegalHold, acquisition_id)
        if row is None:
            raise _no_hold(acquisition_id)
        return Hold.model_validate(row)


@router.delete("", status_code=204, operation_id="holds.delete")
def delete_hold(context: Context, principal: Permitted, acquisition_id: AcquisitionId) -> None:
    """Release an acquisition: it may be deleted again."""
    with context.database.session() as session:
        locked_acquisition(session, acquisition_id)
        row = session.get(LegalHold, acquisition_id)
        if row is None:
            raise _no_hold(acquisition_id)
        audit(session, principal.key_id, "hold.release", acquisition_id, reason=row.reason)
        session.delete(row)


def _no_hold(acquisition_id: str) -> NotFoundError:
    return NotFoundError(f"Nothing holds {acquisition_id}.", advice="PUT to the same address makes a hold.")
