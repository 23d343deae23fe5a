"""Erasure of specimens, with certificates."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from fastapi import APIRouter
from pydantic import BaseModel, ConfigDict, Field

from specimap_infra.tables import Acquisition, CloudRow
from specimap_infra.tables import Erasure as ErasureRow
from specimap_service.acquisitions.routes import Pseudonym
from specimap_service.auth.dependencies import Permitted
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import Context, correlation_id
from specimap_service.paging import After, Limit, Page, Sort, page_of, paged

router = APIRouter(prefix="/v1/erasures", tags=["erasures"])


class ErasureRequest(BaseModel):
    """A specimen to erase. Its id stands in the body, since addresses end up in the logs of proxies."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"specimen_id": "SP-2026-0117"}})

    specimen_id: Pseudonym


class ErasureView(BaseModel):
    """An erasure and its certificate."""

    model_config = ConfigDict(title="Erasure", from_attributes=True)

    id: str
    state: str = Field(description="`done`, or `running` where it was stopped: the same request goes on.")
    acquisitions: list[str]
    created_at: datetime.datetime
    created_by: str
    certificate: dict[str, Any] | None = Field(
        description="Signed with Ed25519: counts of what was removed and of what is left, the place in the audit trail."
    )


@router.post("", status_code=201, operation_id="erasures.create")
def create_erasure(context: Context, principal: Permitted, clouds: CloudsDep, wanted: ErasureRequest) -> ErasureView:
    """Erase a specimen: all its acquisitions, of all projects, with files, jobs, results, labels, exports and shares.

    This cannot be undone. The answer holds the certificate, which is kept too.
    """
    # Imported late: the library of signatures is of no use before.
    from specimap_hospital.erasure import Eraser

    with context.database.session() as session:
        mine = sa.select(CloudRow.id).join(Acquisition, Acquisition.id == CloudRow.acquisition_id)
        open_clouds = session.scalars(mine.where(Acquisition.specimen_id == wanted.specimen_id)).all()
    eraser = Eraser(context.database, context.storage, context.settings, context.queue)
    row = eraser.erase(wanted.specimen_id, principal.key_id, correlation_id())
    for cloud_id in open_clouds:
        clouds.forget(cloud_id)
    return ErasureView.model_validate(row)


@router.get("", operation_id="erasures.list")
def list_erasures(
    context: Context, principal: Permitted, after: After = None, limit: Limit = 50, sort: Sort = "-created_at"
) -> Page[ErasureView]:
    """List the erasures."""
    with context.database.session() as session:
        rows = list(session.scalars(paged(sa.select(ErasureRow), ErasureRow.id, after, limit, sort)))
    return page_of([ErasureView.model_validate(row) for row in rows], [row.id for row in rows], limit)
