"""Jobs: created, followed, cancelled, repeated, deleted."""

from __future__ import annotations

from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.sse import KEEPALIVE_COMMENT, EventSourceResponse, format_sse_event

from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_text
from specimap_core.report.model import Report
from specimap_infra.errors import JobConflictError
from specimap_infra.job_schemas import JobState, JobView, job_views
from specimap_infra.jobs import locked, request_cancel
from specimap_infra.tables import CloudRow, Job, JobEvent
from specimap_service.auth.access import in_sight
from specimap_service.auth.dependencies import Permitted, trust_of
from specimap_service.auth.object_ids import JobId
from specimap_service.clouds.dependencies import CloudsDep
from specimap_service.context import AppContext, Context, audit
from specimap_service.idempotency import IdempotencyKey, repeated
from specimap_service.jobs.commands import delete_job, found_job, new_job, repeated_job, stop_workflow
from specimap_service.jobs.dependencies import EventsDep, StreamPlace
from specimap_service.jobs.events import Event, position
from specimap_service.jobs.schemas import (
    AfterJob,
    AfterSeq,
    JobRequest,
    LastEventId,
    LogLine,
    RerunRequest,
)
from specimap_service.paging import CreatedAfter, CreatedBefore, InProject, Limit, Page, Sort, page_of, paged

router = APIRouter(prefix="/v1", tags=["jobs"])

REPEATED = repeated(JobView)


@router.post("/jobs", status_code=202, responses=REPEATED, operation_id="jobs.create")
def create_job(
    context: Context,
    principal: Permitted,
    response: Response,
    wanted: JobRequest,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Queue a job on a complete acquisition."""
    return _answer(response, *new_job(context, principal, wanted, idempotency_key))


@router.post("/jobs/{job_id}/rerun", status_code=202, responses=REPEATED, operation_id="jobs.rerun")
def rerun_job(
    context: Context,
    principal: Permitted,
    response: Response,
    job_id: JobId,
    wanted: RerunRequest | None = None,
    idempotency_key: IdempotencyKey = None,
) -> JobView:
    """Queue this job again with other settings; stages that they do not change are not repeated."""
    return _answer(response, *repeated_job(context, principal, job_id, wanted or RerunRequest(), idempotency_key))


def _answer(response: Response, job: JobView, made: bool) -> JobView:
    response.headers["Location"] = f"/v1/jobs/{job.id}"
    response.status_code = 202 if made else 200
    return job


@router.get("/jobs", operation_id="jobs.list")
def list_jobs(
    context: Context,
    principal: Permitted,
    acquisition_id: Annotated[
        str | None, Query(pattern=r"^acq_[0-9a-z]{26}$", description="Only jobs on this one.")
    ] = None,
    state: Annotated[list[JobState] | None, Query(description="Any of these states.")] = None,
    created_after: CreatedAfter = None,
    created_before: CreatedBefore = None,
    project: InProject = None,
    after: AfterJob = None,
    limit: Limit = 100,
    sort: Sort = "-created_at",
) -> Page[JobView]:
    """List jobs."""
    query = sa.select(Job).where(in_sight(principal, Job, project))
    if acquisition_id is not None:
        query = query.where(Job.acquisition_id == acquisition_id)
    if state:
        query = query.where(Job.state.in_(state))
    if created_after is not None:
        query = query.where(Job.created_at >= created_after)
    if created_before is not None:
        query = query.where(Job.created_at < created_before)
    query = paged(query, Job.id, after, limit, sort)
    with context.database.session() as session:
        jobs = job_views(session, list(session.scalars(query)))
    return page_of(jobs, [job.id for job in jobs], limit)


@router.get("/jobs/{job_id}", operation_id="jobs.get")
def get_job(context: Context, principal: Permitted, job_id: JobId) -> JobView:
    """Return a job as it is now."""
    with context.database.session() as session:
        return job_views(session, [found_job(session, job_id)])[0]


@router.post("/jobs/{job_id}/cancel", status_code=202, operation_id="jobs.cancel")
def cancel_job(context: Context, principal: Permitted, job_id: JobId) -> JobView:
    """Cancel a job that waits or runs; results of its finished stages are kept for a rerun."""
    with context.database.session() as session:
        before = locked(session, job_id)
        is_change = before is not None and before.state != "cancelled"
        (view,) = job_views(session, [request_cancel(session, job_id)])
        if is_change:
            audit(session, principal.key_id, "job.cancel", job_id)
    stop_workflow(context, job_id)
    return view


@router.delete("/jobs/{job_id}", status_code=204, operation_id="jobs.delete")
def remove_job(context: Context, principal: Permitted, clouds: CloudsDep, job_id: JobId) -> None:
    """Delete a job that has ended, with its result."""
    delete_job(context, clouds, principal.key_id, job_id)


@router.get("/jobs/{job_id}/report", operation_id="jobs.get_report")
def get_report(context: Context, principal: Permitted, job_id: JobId) -> Report:
    """Return the report on the job's result."""
    with context.database.session() as session:
        job = found_job(session, job_id)
        if job.state != "succeeded":
            raise JobConflictError(
                f"Job {job_id} is {job.state}; only a job that succeeded has a report.",
                advice="Wait for it to succeed; `error` says why it failed.",
                state=job.state,
            )
        report = session.scalar(sa.select(CloudRow.report).where(CloudRow.job_id == job_id))
    if report is None:
        raise NotFoundError(f"Job {job_id} has no result any more.", advice="Rerun it.")
    return Report.model_validate(report)


@router.get("/jobs/{job_id}/log", operation_id="jobs.get_log")
def get_log(
    context: Context,
    principal: Permitted,
    job_id: JobId,
    after: AfterSeq = None,
    limit: Limit = 100,
    sort: Sort = "created_at",
) -> Page[LogLine]:
    """Return the job's log."""
    query = sa.select(JobEvent).where(JobEvent.job_id == job_id, JobEvent.type == "log")
    query = paged(query, JobEvent.seq, after, limit, sort)
    with context.database.session() as session:
        found_job(session, job_id)
        lines = [
            LogLine(seq=row.seq, at=row.at, level=row.data["level"], message=row.data["message"], data=row.data["data"])
            for row in session.scalars(query)
        ]
    return page_of(lines, [str(line.seq) for line in lines], limit)


@router.get(
    "/jobs/{job_id}/events",
    response_class=Response,
    responses={
        200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}, "description": "Events as they occur"},
        204: {"description": "The job has ended and there is no event after the last one seen: do not reconnect"},
    },
    operation_id="jobs.follow_events",
)
async def follow_events(
    context: Context,
    principal: Permitted,
    place: StreamPlace,
    events: EventsDep,
    request: Request,
    job_id: JobId,
    last_event_id: LastEventId = None,
    after: AfterSeq = None,
) -> Response:
    """Stream the job's events, from its beginning or after the last event seen, until it ends; also when the key
    is revoked or expires. A key may follow `SPECIMAP_MAX_STREAMS_PER_KEY` streams.

    `event` is `state` {state, error, cloud_id}, `progress` {stage, progress} or `log` {level, message, data}; `id`
    counts from 1. A comment is sent every 15 s while there is no event.
    """
    start = await run_in_threadpool(_position, context, job_id, int(last_event_id) if last_event_id else after or 0)
    if start is None:
        return Response(status_code=204)
    return EventSourceResponse(
        _encoded(events.follow(job_id, start, trust_of(request))),
        # Proxies that buffer answers would hold the events back.
        headers={"Cache-Control": "no-store", "X-Accel-Buffering": "no"},
    )


def _position(context: AppContext, job_id: str, seen: int) -> int | None:
    with context.database.session() as session:
        return position(session, found_job(session, job_id), seen)


async def _encoded(events: AsyncGenerator[Event | None]) -> AsyncIterator[bytes]:
    async with aclosing(events):
        async for event in events:
            if event is None:
                yield KEEPALIVE_COMMENT
                continue
            yield format_sse_event(data_str=json_text(event.data), event=event.type, id=str(event.seq))
