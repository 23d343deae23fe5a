"""The audit trail, for an administrator."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

import sqlalchemy as sa
from fastapi import APIRouter, Query
from pydantic import BaseModel, ConfigDict, Field

from specimap_infra.tables import AuditEntry
from specimap_service.auth.access import in_sight
from specimap_service.auth.dependencies import Permitted
from specimap_service.context import Context
from specimap_service.paging import InProject, Limit, Moment, Page, Sort, page_of, paged

router = APIRouter(prefix="/v1", tags=["keys"])
Kind = Literal["change", "access", "service", "all"]


class Audited(BaseModel):
    """An entry of the audit trail: an actor did an action to an object."""

    model_config = ConfigDict(title="AuditEntry", from_attributes=True)

    id: int
    at: datetime.datetime
    key_id: str = Field(description="The actor: a key, a share, or a program by its name; empty where none was known.")
    project_id: str = Field(description="The target's project.")
    action: str
    target: str
    details: dict[str, Any]
    correlation_id: str
    kind: str = Field(
        description="`change`; `access`: a read, or a request that was refused or failed; `service`: of the program."
    )
    outcome: str = Field(description="`success`, `refused` or `failed`.")
    status: int | None = Field(description="HTTP status of the answer, for an access.")
    acquisition_id: str | None = Field(description="The acquisition that the target belongs to.")
    address: str = Field(description="Where the request came from: a pseudonym, unless the settings say otherwise.")
    count: int = Field(description="How many like requests the entry stands for.")
    seq: int | None = Field(description="Its place in the chain; null for the first second.")
    previous_hash: str | None = Field(description="Hash of the record before it.")
    hash: str | None = Field(description="Hash of the entry, its place and the hash before it.")


@router.get("/audit", operation_id="audit.list")
def list_audit(
    context: Context,
    principal: Permitted,
    target: Annotated[
        str | None, Query(pattern=r"^[a-z]{2,6}_[0-9a-z]{26}$", description="Only entries about this object.")
    ] = None,
    acquisition: Annotated[
        str | None,
        Query(pattern=r"^acq_[0-9a-z]{26}$", description="Only entries about this acquisition or what belongs to it."),
    ] = None,
    actor: Annotated[
        str | None, Query(pattern=r"^[A-Za-z0-9_.-]{1,64}$", description="Only entries of this key, share or program.")
    ] = None,
    action: Annotated[
        str | None, Query(pattern=r"^[a-z_]{1,32}(\.[a-z_]{1,32})?$", description="Only this action.")
    ] = None,
    outcome: Annotated[
        Literal["success", "refused", "failed"] | None, Query(description="Only entries with this outcome.")
    ] = None,
    kind: Annotated[Kind, Query(description="Changes by default; `access`: reads and refusals; or `all`.")] = "change",
    created_after: Annotated[Moment | None, Query(description="Only entries of this time or later.")] = None,
    created_before: Annotated[Moment | None, Query(description="Only entries before this time.")] = None,
    project: InProject = None,
    after: Annotated[int | None, Query(ge=1, le=10**18, description="`next` of the page before.")] = None,
    limit: Limit = 100,
    sort: Sort = "-created_at",
) -> Page[Audited]:
    """List the audit trail."""
    # What this process has answered so far is in the list.
    context.trail.flush()
    query = sa.select(AuditEntry).where(in_sight(principal, AuditEntry, project))
    columns = {
        AuditEntry.target: target,
        AuditEntry.acquisition_id: acquisition,
        AuditEntry.key_id: actor,
        AuditEntry.action: action,
        AuditEntry.outcome: outcome,
        AuditEntry.kind: None if kind == "all" else kind,
    }
    for column, wanted in columns.items():
        if wanted is not None:
            query = query.where(column == wanted)
    if created_after is not None:
        query = query.where(AuditEntry.at >= created_after)
    if created_before is not None:
        query = query.where(AuditEntry.at < created_before)
    query = paged(query, AuditEntry.id, after, limit, sort)
    with context.database.session() as session:
        rows = list(session.scalars(query))
    return page_of([Audited.model_validate(row) for row in rows], [str(row.id) for row in rows], limit)
