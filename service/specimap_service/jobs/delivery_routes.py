"""Deliveries of a job's webhook: listed, and made again on request."""

from __future__ import annotations

import datetime
from typing import Literal

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_infra import tables
from specimap_infra.errors import JobConflictError
from specimap_infra.ids import new_id
from specimap_infra.jobs import locked
from specimap_infra.notifications import DELIVERIES, tell
from specimap_infra.tables import FINAL_STATES
from specimap_infra.webhooks import check_target
from specimap_service.auth.access import not_found
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import JobId
from specimap_service.context import Context, audit
from specimap_service.idempotency import IdempotencyKey, Repeatable, repeated
from specimap_service.jobs.commands import found_job
from specimap_service.paging import After, MaybeLimit, Sort, listed, paged

router = APIRouter(prefix="/v1", tags=["deliveries"])


class Delivery(BaseModel):
    """A notification about the end of a job, repeated until the receiver takes it."""

    model_config = ConfigDict(from_attributes=True)

    id: str = Field(description="Stands in `X-Specimap-Delivery`; the same in each attempt.")
    job_id: str
    state: Literal["pending", "delivered", "given_up"]
    attempts: int = Field(description="Attempts so far.")
    last_status: str | None = Field(description="The receiver's HTTP status, or what went wrong, at the last attempt.")
    next_at: datetime.datetime = Field(description="While it is pending: when the next attempt is due.")


@router.get("/jobs/{job_id}/deliveries", operation_id="deliveries.list")
def list_deliveries(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    job_id: JobId,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "created_at",
) -> list[Delivery]:
    """List the deliveries of a job's webhook: one when it has ended, and those asked for since."""
    query = sa.select(tables.Delivery).where(tables.Delivery.job_id == job_id)
    with context.database.session() as session:
        found_job(session, job_id)
        rows = session.scalars(paged(query, tables.Delivery.id, after, limit, sort))
        deliveries = [Delivery.model_validate(row) for row in rows]
    return listed(request, response, deliveries, [delivery.id for delivery in deliveries], limit)


@router.post(
    "/jobs/{job_id}/deliveries", status_code=202, responses=repeated(Delivery), operation_id="deliveries.create"
)
def create_delivery(
    context: Context, principal: Permitted, response: Response, job_id: JobId, idempotency_key: IdempotencyKey = None
) -> Delivery:
    """Send a job's webhook again, as a delivery of its own: with the job as it is now, a new id and new attempts."""

    def make(session: Session, _: str) -> tuple[str, Delivery]:
        job = locked(session, job_id)
        if job is None:
            raise not_found(job_id)
        if job.webhook is None:
            raise JobConflictError(f"Job {job_id} has no webhook.", advice="Name one when you create or rerun a job.")
        if job.state not in FINAL_STATES:
            raise JobConflictError(
                f"Job {job_id} is {job.state}; its webhook is sent when it has ended.",
                advice="Wait for it.",
                state=job.state,
            )
        check_target(job.webhook["url"], context.settings)
        row = tables.Delivery(id=new_id("dlv"), job_id=job_id, state="pending")
        session.add(row)
        session.flush()
        tell(session, DELIVERIES)
        audit(session, principal.key_id, "job.notify", job_id, delivery=row.id)
        return row.id, Delivery.model_validate(row)

    def again(session: Session, delivery_id: str, _: str) -> Delivery:
        row = session.get(tables.Delivery, delivery_id)
        if row is None:
            raise NotFoundError(f"There is no delivery {delivery_id} any more.", advice="Ask for a new one.")
        return Delivery.model_validate(row)

    request = Repeatable.of(principal, idempotency_key, "deliveries.create", {"job": job_id})
    delivery, new = request.once(context.database, make, again)
    response.status_code = 202 if new else 200
    return delivery
