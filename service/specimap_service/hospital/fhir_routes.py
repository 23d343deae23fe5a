"""The FHIR server that is told of a result: how far that has come, and telling it again."""

from __future__ import annotations

import datetime
from typing import Any, Literal

import sqlalchemy as sa
from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from specimap_core.errors import NotFoundError
from specimap_hospital.fhir.notices import tell_of
from specimap_infra.database import utc_now
from specimap_infra.errors import FhirServerMissingError, StudyMissingError
from specimap_infra.labels import lock_cloud
from specimap_infra.studies import study_keys
from specimap_infra.tables import CloudRow, SealedStudy
from specimap_infra.tables import FhirNotice as NoticeRow
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import CloudId
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import Context, audit

router = APIRouter(prefix="/v1/clouds/{cloud_id}/fhir", tags=["fhir"])


class FhirNotice(BaseModel):
    """How far the FHIR server has been told of a result. It says nothing of the patient."""

    model_config = ConfigDict(
        from_attributes=True,
        json_schema_extra={
            "example": {
                "cloud_id": "cloud_01m2v0k3h5q7xg8w9c4e6t1n2b",
                "state": "sent",
                "attempts": 1,
                "next_at": "2026-11-28T10:00:02Z",
                "sent_at": "2026-11-28T10:00:01Z",
            }
        },
    )

    cloud_id: str
    state: Literal["pending", "sent", "refused", "given_up"] = Field(
        description="`refused`: the server would refuse it again; `given_up`: after the last attempt."
    )
    attempts: int
    next_at: datetime.datetime = Field(description="While it is pending: when the next attempt is due.")
    error: dict[str, Any] | None = Field(None, description="Of the last attempt: code, message, advice, details.")
    sent_at: datetime.datetime | None = None


@router.get("", operation_id="fhir.get")
def get_notice(context: Context, principal: Permitted, clouds: CloudsDep, cloud_id: CloudId) -> FhirNotice:
    """Return how far the FHIR server has been told of a result."""
    clouds.record(cloud_id)
    with context.database.session() as session:
        row = session.get(NoticeRow, cloud_id)
        if row is None:
            raise NotFoundError(
                "The FHIR server is not to be told of this result.",
                advice="That takes a study context and SPECIMAP_FHIR_URL; POST here asks for it.",
            )
        return FhirNotice.model_validate(row)


@router.post("", status_code=202, operation_id="fhir.create")
def send_notice(context: Context, principal: Permitted, clouds: CloudsDep, cloud_id: CloudId) -> FhirNotice:
    """Tell the FHIR server of a result, or tell it again: it replaces what it was told before."""
    clouds.record(cloud_id)
    if not context.settings.fhir_url:
        raise FhirServerMissingError(
            "No FHIR server is set.", advice="Ask whoever runs the service to set SPECIMAP_FHIR_URL."
        )
    study_keys(context.settings)
    with context.database.session() as session:
        lock_cloud(session, cloud_id)
        of_cloud = sa.select(CloudRow.acquisition_id).where(CloudRow.id == cloud_id)
        query = sa.select(SealedStudy.version).where(SealedStudy.acquisition_id == of_cloud.scalar_subquery())
        version = session.scalar(query)
        if version is None:
            raise StudyMissingError(
                "The acquisition has no study context, so nobody knows whose the result is.",
                advice="PUT /v1/acquisitions/{id}/study first.",
                cloud_id=cloud_id,
            )
        row = tell_of(session, cloud_id, version, utc_now())
        audit(session, principal.key_id, "fhir.request", cloud_id)
        return FhirNotice.model_validate(row)
