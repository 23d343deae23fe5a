"""Tables of the work: jobs, their events, artefacts and webhooks; leases of workers."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base, in_project, owned_by
from specimap_infra.tables.names import QUEUED


class Job(Base):
    """A run of the pipeline on an acquisition. ``id`` is the workflow's id at the job engine too."""

    __tablename__ = "jobs"
    __table_args__ = (
        sa.UniqueConstraint("created_by", "idempotency_key"),
        sa.Index("ix_jobs_project_id", "project_id", "id"),
        sa.Index("ix_jobs_queued", "priority", "created_at", "id", postgresql_where=QUEUED, sqlite_where=QUEUED),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    acquisition_id: Mapped[str] = owned_by("acquisitions")
    project_id: Mapped[str] = in_project()
    settings: Mapped[dict[str, Any]]
    priority: Mapped[int]
    state: Mapped[str] = mapped_column(index=True)
    stage: Mapped[str | None]
    progress: Mapped[float] = mapped_column(default=0.0)
    """Share of the running stage, 0 to 1."""
    error: Mapped[dict[str, Any] | None]
    """Code, message, advice and details of the failure."""
    starts: Mapped[int] = mapped_column(default=0)
    """How often a worker took it up."""
    setbacks: Mapped[dict[str, Any]] = mapped_column(default=dict, server_default=sa.text("'{}'"))
    """Of :mod:`specimap_infra.setbacks`, since the last finished stage."""
    executor: Mapped[str | None]
    """The worker that may write to this row: one that lost its lease finds another's name here."""
    idempotency_key: Mapped[str | None]
    """Of jobs from before :class:`RepeatableRequest`; nobody writes or reads it."""
    request_hash: Mapped[str]
    correlation_id: Mapped[str]
    rerun_of: Mapped[str | None]
    webhook: Mapped[dict[str, Any] | None]
    seconds: Mapped[dict[str, Any]] = mapped_column(default=dict)
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    started_at: Mapped[datetime.datetime | None]
    finished_at: Mapped[datetime.datetime | None]
    created_by: Mapped[str]


class RepeatableRequest(Base):
    """A request with an idempotency key: sent again, it finds what it made. Kept for some days."""

    __tablename__ = "repeatable_requests"

    key_id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    """The idempotency key, a name that the client gave."""
    request_hash: Mapped[str]
    object_id: Mapped[str]
    salt: Mapped[str]
    """Of the secret of a key that the request made: with it, and the key that made the request, it is shown again."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)


class JobEvent(Base):
    """An event of a job: state, progress or log line. Clients resume after the number ``seq``."""

    __tablename__ = "job_events"

    job_id: Mapped[str] = mapped_column(sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    seq: Mapped[int] = mapped_column(primary_key=True)
    type: Mapped[str]
    """``state``, ``progress`` or ``log``."""
    data: Mapped[dict[str, Any]]
    at: Mapped[datetime.datetime] = mapped_column(default=utc_now)


class Artefact(Base):
    """The result of a finished stage, found again by the hash of its inputs."""

    __tablename__ = "artefacts"
    __table_args__ = (sa.UniqueConstraint("acquisition_id", "stage", "key"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    acquisition_id: Mapped[str] = owned_by("acquisitions")
    stage: Mapped[str]
    key: Mapped[str]
    storage_key: Mapped[str]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    seconds: Mapped[float]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)


class Delivery(Base):
    """A webhook to be delivered, and the state of its delivery."""

    __tablename__ = "deliveries"

    id: Mapped[str] = mapped_column(primary_key=True)
    job_id: Mapped[str] = owned_by("jobs")
    state: Mapped[str]
    """``pending``, ``delivered`` or ``given_up``."""
    attempts: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    last_status: Mapped[str | None]


class Lease(Base):
    """The heartbeat of a worker, in seconds of the database's clock."""

    __tablename__ = "leases"

    executor: Mapped[str] = mapped_column(primary_key=True)
    host: Mapped[str]
    kind: Mapped[str]
    started: Mapped[float]
    heartbeat: Mapped[float]
