"""Create and delete jobs: the row, its first event and the engine's workflow together or not at all."""

from __future__ import annotations

from collections.abc import Callable

import sqlalchemy as sa
from dbos import error as dbos_error
from sqlalchemy.exc import IntegrityError, SQLAlchemyError
from sqlalchemy.orm import Session

from specimap_infra.completeness import missing
from specimap_infra.deletion import check_not_held
from specimap_infra.errors import JobConflictError
from specimap_infra.ids import new_id
from specimap_infra.job_schemas import JobView, job_settings, job_views
from specimap_infra.jobs import append_event, locked
from specimap_infra.logs import logger
from specimap_infra.queue import JOBS, RUN_JOB, enqueue
from specimap_infra.tables import FINAL_STATES, PRIORITIES, Acquisition, Job
from specimap_infra.webhooks import check_target
from specimap_service.auth.access import load, not_found
from specimap_service.auth.keys import Principal
from specimap_service.auth.permissions import URGENT
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.context import AppContext, audit, correlation_id
from specimap_service.errors import ForbiddenError, UploadIncompleteError
from specimap_service.idempotency import Repeatable
from specimap_service.jobs.deletion import JobFiles
from specimap_service.jobs.schemas import JobRequest, RerunRequest, Webhook


def new_job(
    context: AppContext, principal: Principal, wanted: JobRequest, idempotency_key: str | None
) -> tuple[JobView, bool]:
    """Create a job on an acquisition; return it, and whether it is new.

    Raises:
        NotFoundError: there is no such acquisition.
        ForbiddenError: the key may not ask for this priority.
        UploadIncompleteError: something is missing; ``details['missing']``.
        SettingsError: the webhook's host is not allowed.
        IdempotencyConflictError: the idempotency key belongs to another request.
    """

    def row(session: Session) -> Job:
        acquisition = load(session, principal, Acquisition, wanted.acquisition_id)
        _check_priority(principal, PRIORITIES[wanted.priority])
        return Job(
            acquisition_id=acquisition.id,
            project_id=acquisition.project_id,
            settings=wanted.settings.on(acquisition),
            priority=PRIORITIES[wanted.priority],
            webhook=_checked_webhook(context, wanted.webhook),
        )

    return _create_once(context, principal.key_id, idempotency_key, wanted.digest(), row)


def repeated_job(
    context: AppContext, principal: Principal, job_id: str, wanted: RerunRequest, idempotency_key: str | None
) -> tuple[JobView, bool]:
    """Create a job with an earlier one's settings, but for those given; return it, and whether it is new.

    Raises:
        NotFoundError: there is no such job.
        ForbiddenError, UploadIncompleteError, SettingsError, IdempotencyConflictError: as for :func:`new_job`.
    """

    def row(session: Session) -> Job:
        earlier = found_job(session, job_id)
        changed = wanted.settings.model_dump(exclude_unset=True, exclude_none=True) if wanted.settings else {}
        webhook = wanted.webhook
        if "webhook" not in wanted.model_fields_set and earlier.webhook is not None:
            webhook = Webhook(**earlier.webhook)
        priority = PRIORITIES[wanted.priority] if wanted.priority else earlier.priority
        _check_priority(principal, priority)
        return Job(
            acquisition_id=earlier.acquisition_id,
            project_id=earlier.project_id,
            settings=job_settings({**earlier.settings, **changed}).model_dump(),
            priority=priority,
            webhook=_checked_webhook(context, webhook),
            rerun_of=earlier.id,
        )

    return _create_once(context, principal.key_id, idempotency_key, wanted.digest(job_id), row)


def found_job(session: Session, job_id: str) -> Job:
    """Return the job's row. Raises NotFoundError."""
    job = session.get(Job, job_id)
    if job is None:
        raise not_found(job_id)
    return job


def _create_once(
    context: AppContext, key_id: str, idempotency_key: str | None, digest: str, row: Callable[[Session], Job]
) -> tuple[JobView, bool]:
    acquisition_id = ""

    def make(session: Session, _: str) -> tuple[str, JobView]:
        nonlocal acquisition_id
        job = row(session)
        acquisition_id = job.acquisition_id
        missing_files = missing(session, job.acquisition_id)
        if missing_files:
            raise UploadIncompleteError(
                f"Acquisition {job.acquisition_id} is not complete: {missing_files[0]}",
                advice="Upload what is missing, then ask again.",
                missing=missing_files,
            )
        job.id, job.state, job.created_by = new_id("job"), "queued", key_id
        job.request_hash, job.correlation_id = digest, correlation_id()
        session.add(job)
        session.flush()
        append_event(session, job.id, "state", {"state": "queued", "starts": 0})
        enqueue(context.queue, session, JOBS, RUN_JOB, job.id, job.priority)
        audit(session, key_id, "job.create", job.id, acquisition=job.acquisition_id, rerun_of=job.rerun_of)
        return job.id, job_views(session, [job])[0]

    def again(session: Session, job_id: str, _: str) -> JobView:
        return job_views(session, [found_job(session, job_id)])[0]

    try:
        return Repeatable(key_id, idempotency_key, digest).once(context.database, make, again)
    except IntegrityError as error:
        # The acquisition was deleted.
        raise not_found(acquisition_id) from error


def _check_priority(principal: Principal, priority: int) -> None:
    """Raise ForbiddenError where a key asks for theatre's place in the queue without the right to it."""
    if priority == PRIORITIES["intraoperative"] and not principal.may(URGENT):
        raise ForbiddenError(
            "The key may not create jobs of the priority intraoperative.",
            advice="Ask for the priority routine, or use a key that has the scope intraoperative.",
            scope="intraoperative",
        )


def _checked_webhook(context: AppContext, webhook: Webhook | None) -> dict[str, str] | None:
    if webhook is None:
        return None
    check_target(webhook.url, context.settings)
    return webhook.model_dump()


# ---- cancelling and deleting --------------------------------------------------------------------------


def stop_workflow(context: AppContext, job_id: str) -> None:
    """Cancel a job's workflow at the engine. Where that fails, the worker learns of it from the job's row."""
    _call_engine(context.queue.cancel_workflow, job_id)


def delete_job(context: AppContext, clouds: OpenClouds, key_id: str, job_id: str) -> None:
    """Delete a job that has ended, its result, and all their files.

    Raises:
        NotFoundError: there is no such job.
        JobConflictError: it has not ended.
        StorageUnavailableError: the rows are gone, but files may be left.
    """
    with context.database.session() as session:
        job = locked(session, job_id) or found_job(session, job_id)
        if job.state not in FINAL_STATES:
            raise JobConflictError(f"Job {job_id} is {job.state}.", advice="Cancel it first.", state=job.state)
        check_not_held(session, job.acquisition_id)
        acquisition, files = job.acquisition_id, JobFiles.of(session, [job_id])
        audit(session, key_id, "job.delete", job_id, acquisition=acquisition)
        session.execute(sa.delete(Job).where(Job.id == job_id))
    _call_engine(context.queue.delete_workflow, job_id)
    files.remove(context.storage, clouds)


def _call_engine(call: Callable[[str], None], job_id: str) -> None:
    try:
        call(job_id)
    except (SQLAlchemyError, dbos_error.DBOSException) as error:
        logger().warning("a call to the job engine failed", job=job_id, error=type(error).__name__)
