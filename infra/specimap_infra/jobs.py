"""Changes to jobs' rows and their events, all of them, by the API and the workers.

Every function runs within the caller's transaction, first locks the job's row, and writes an event with each change,
so that a reader of the events misses none. Writes of workers are fenced: a job belongs to the executor that claimed it
last, and a write by another, or after the end, changes nothing and raises LostLeaseError.
"""

from __future__ import annotations

import math
from typing import Any, Literal, TypeVar

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError, SpecimapError
from specimap_core.json_text import json_ready
from specimap_infra.database import database_seconds, utc_now
from specimap_infra.errors import JobConflictError, LostLeaseError
from specimap_infra.ids import new_id
from specimap_infra.notifications import DELIVERIES, JOB_EVENTS, tell
from specimap_infra.setbacks import Setbacks
from specimap_infra.tables import FINAL_STATES, CloudRow, Delivery, Export, Job, JobEvent

State = Literal["queued", "running", "succeeded", "failed", "cancelled"]
FinalState = Literal["succeeded", "failed", "cancelled"]
Stage = Literal["reconstruct", "adjust", "render", "register"]
EventType = Literal["state", "progress", "log"]
Level = Literal["debug", "info", "warning", "error"]
Worked = TypeVar("Worked", Job, Export)
Failure = SpecimapError | dict[str, Any]
"""An error, or its ``as_dict`` from another process."""

FOLLOWING: dict[str, frozenset[str]] = {
    "queued": frozenset({"running", "failed", "cancelled"}),
    # To running again: another worker takes over.
    "running": frozenset({"queued", "running", "succeeded", "failed", "cancelled"}),
    "succeeded": frozenset(),
    "failed": frozenset(),
    "cancelled": frozenset(),
}
"""States that may follow a state."""


# ---- workers ------------------------------------------------------------------------------------------


def claim(session: Session, job_id: str, executor: str) -> Job | None:
    """Claim a job: it runs, and belongs to ``executor`` from now on, even if another one held it before.

    Returns: the job, with this start counted; None if it was deleted or has ended (cancelled while it waited).
    """
    job = locked(session, job_id)
    if job is None or job.state in FINAL_STATES:
        return None
    job.starts += 1
    job.setbacks = Setbacks.of(job.setbacks).attempted().stored()
    job.started_at = job.started_at or utc_now()
    _change(session, job, "running", executor=executor)
    return job


def report_progress(session: Session, job_id: str, executor: str, stage: Stage, share: float) -> None:
    """Record the progress of the running stage, 0 to 1.

    Raises:
        LostLeaseError: the job is not this executor's.
    """
    job = held(session, job_id, executor)
    job.stage, job.progress = stage, min(max(share, 0.0), 1.0) if math.isfinite(share) else 0.0
    _append(session, job, "progress", {"stage": stage, "progress": round(job.progress, 4)})


def log(session: Session, job_id: str, executor: str, level: Level, message: str, **data: object) -> None:
    """Add a line to the job's log; ``data`` are JSON values, without names that came with uploads.

    Raises:
        LostLeaseError: the job is not this executor's.
    """
    job = held(session, job_id, executor)
    _append(session, job, "log", {"level": level, "message": message, "data": data})


def finish(
    session: Session,
    job_id: str,
    executor: str,
    state: FinalState,
    error: Failure | None = None,
    seconds: dict[str, float] | None = None,
) -> None:
    """End a job; ``seconds`` by stage. The cloud's row is added in the same transaction, before this.

    Raises:
        LostLeaseError: the job is not this executor's.
    """
    job = held(session, job_id, executor)
    if seconds is not None:
        job.seconds = {stage: round(value, 3) for stage, value in seconds.items()}
    _change(session, job, state, executor=executor, error=error)


def set_back(session: Session, job_id: str, executor: str, name: str, *, crash: bool) -> Setbacks:
    """Note that the process of the running stage ended: ``crash`` by itself, else from outside.

    ``name``: of this one end, which counts once however often it is told. Returns: the setbacks of the stage.

    Raises:
        LostLeaseError: the job is not this executor's.
    """
    job = held(session, job_id, executor)
    before = Setbacks.of(job.setbacks)
    after = before.crashed(name) if crash else before.interrupted(name, _now(session))
    job.setbacks = after.stored()
    return after


def release(session: Session, job_id: str, executor: str, *, died: bool) -> Job | None:
    """Put a job that an executor leaves back into the queue for another to claim. Not fenced: only for hand-overs.

    ``died``: it ended in the middle of its work, which is a setback of the job; one that stops in order is none.

    Returns: the job; None if it was deleted or has ended.
    """
    job = locked(session, job_id)
    if job is None or job.state in FINAL_STATES:
        return None
    if job.state == "running" and job.executor == executor:
        if died:
            job.setbacks = Setbacks.of(job.setbacks).interrupted(executor, _now(session)).stored()
        _change(session, job, "queued")
    return job


def take_back(session: Session, executor: str) -> None:
    """Take back that an executor died: it was silent for longer than its lease, and lives."""
    rows: list[Job | Export] = [*session.scalars(_set_back_by(Job, executor))]
    rows += session.scalars(_set_back_by(Export, executor))
    for row in rows:
        row.setbacks = Setbacks.of(row.setbacks).without(executor).stored()


def _set_back_by(table: type[Worked], executor: str) -> sa.Select[Worked]:
    noted = sa.cast(table.setbacks, sa.String).contains(executor, autoescape=True)
    return sa.select(table).where(table.state.not_in(FINAL_STATES), noted).with_for_update()


def may_go_on(session: Session, setbacks: Setbacks) -> bool:
    """Whether the pause after a setback is over."""
    return setbacks.retry_at <= _now(session)


def _now(session: Session) -> float:
    return session.scalars(sa.select(database_seconds(session.get_bind()))).one()


def fail_orphan(session: Session, job_id: str, error: Failure) -> Job | None:
    """Fail a job that no worker can finish. Not fenced: only for the check of leases.

    Returns: the job; None if it was deleted or has ended.
    """
    job = locked(session, job_id)
    if job is None or job.state in FINAL_STATES:
        return None
    _change(session, job, "failed", error=error)
    return job


# ---- API ----------------------------------------------------------------------------------------------


def request_cancel(session: Session, job_id: str) -> Job:
    """Cancel a job: its row at once; the caller cancels the engine's workflow after the commit.

    A worker that still runs it learns of it at its next write. Cancelling twice is not an error.

    Raises:
        NotFoundError: there is no such job.
        JobConflictError: it has succeeded or failed.
    """
    job = _found(session, job_id)
    if job.state != "cancelled":
        _change(session, job, "cancelled")
    return job


# ---- both ---------------------------------------------------------------------------------------------


def set_state(
    session: Session, job_id: str, state: State, *, executor: str | None = None, error: Failure | None = None
) -> None:
    """Change a job's state, with an event, and a delivery where it ends and has a webhook.

    Args:
        executor: the worker that runs or ran it; a job that ends keeps its last executor's name.
        error: the reason for its failure.

    Raises:
        NotFoundError: there is no such job.
        JobConflictError: the state cannot follow the present one; details name both.
        LostLeaseError: ``executor`` ends a job that is another's.
    """
    _change(session, _found(session, job_id), state, executor=executor, error=error)


def append_event(session: Session, job_id: str, type: EventType, data: dict[str, Any]) -> int:
    """Write the job's next event.

    Returns: its number; a job's events are numbered from 1 without a gap.

    Raises:
        NotFoundError: there is no such job.
    """
    return _append(session, _found(session, job_id), type, data)


def locked(session: Session, job_id: str) -> Job | None:
    """Lock the job until the transaction ends, and return it as it is now; None if there is none."""
    # Reading would overwrite changes that this transaction has not sent yet.
    session.flush()
    if session.get_bind().dialect.name == "sqlite":
        # A read takes no lock there, a write takes the only one.
        session.execute(
            sa.update(Job).where(Job.id == job_id).values(starts=Job.starts),
            execution_options={"synchronize_session": False},
        )
    return session.get(Job, job_id, populate_existing=True, with_for_update=True)


def _change(
    session: Session, job: Job, state: State, *, executor: str | None = None, error: Failure | None = None
) -> None:
    """Change the state of a locked job."""
    if state not in FOLLOWING[job.state]:
        raise JobConflictError(
            f"Job {job.id} is {job.state}; it cannot become {state}.",
            advice="A job that has ended stays as it is; rerun it.",
            state=job.state,
            wanted=state,
        )
    event: dict[str, object] = {"state": state}
    if state in FINAL_STATES:
        if executor is not None and job.executor != executor:
            raise _lost(job.id, executor)
        job.finished_at = utc_now()
        job.error = json_ready(error.as_dict() if isinstance(error, SpecimapError) else error)
        event["error"] = job.error
        event["cloud_id"] = session.scalar(sa.select(CloudRow.id).where(CloudRow.job_id == job.id))
        if job.webhook is not None:
            session.add(Delivery(id=new_id("dlv"), job_id=job.id, state="pending"))
            tell(session, DELIVERIES)
    else:
        # The stage stays: it shows in which one workers die, if they do.
        job.executor, job.progress = executor, 0.0
        event["starts"] = job.starts
    job.state = state
    _append(session, job, "state", event)


def _append(session: Session, job: Job, type: EventType, data: dict[str, Any]) -> int:
    """Write the next event of a locked job."""
    last = session.scalar(sa.select(sa.func.max(JobEvent.seq)).where(JobEvent.job_id == job.id)) or 0
    session.add(JobEvent(job_id=job.id, seq=last + 1, type=type, data=json_ready(data)))
    session.flush()
    tell(session, JOB_EVENTS, job.id)
    return last + 1


def _found(session: Session, job_id: str) -> Job:
    job = locked(session, job_id)
    if job is None:
        raise NotFoundError(f"There is no job {job_id}.", advice="Check the id; it may have been deleted.")
    return job


def held(session: Session, job_id: str, executor: str) -> Job:
    """Return the locked job, if it runs and is this executor's.

    Raises:
        LostLeaseError: it does not run, or is another's.
    """
    job = locked(session, job_id)
    if job is None or job.executor != executor or job.state != "running":
        raise _lost(job_id, executor)
    return job


def _lost(job_id: str, executor: str) -> LostLeaseError:
    return LostLeaseError(
        f"Job {job_id} is not {executor}'s any more.",
        advice="Stop working on it: it was cancelled, or another worker runs it.",
        job_id=job_id,
        executor=executor,
    )
