"""Rows that tests about jobs start from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa

from specimap_infra.database import Database
from specimap_infra.ids import new_id
from specimap_infra.job_schemas import JobSettings
from specimap_infra.jobs import append_event
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.tables import Acquisition, Job, JobEvent, StoredFile

CUBE = ("cube.hdr", "cube.raw")
EXECUTOR = "host:0:one"


def acquisition(
    database: Database,
    *,
    photos: int = 6,
    others: Sequence[str] = CUBE,
    edge_mm: float = 6.8,
    project: str = DEFAULT_PROJECT,
) -> str:
    """An acquisition with rows of accepted files, without the files."""
    acquisition_id = new_id("acq")
    labels = [f"photo-{n:04d}.jpg" for n in range(1, photos + 1)] + list(others)
    with database.session() as session:
        session.add(
            Acquisition(
                project_id=project,
                id=acquisition_id,
                specimen_id="S-1",
                accession_number=None,
                dictionary="DICT_4X4_50",
                edge_mm=edge_mm,
                notes="",
                created_by="key_test",
            )
        )
        session.flush()
        for label in labels:
            file_id, role = new_id("file"), label.split("-")[0].split(".")[0]
            session.add(
                StoredFile(
                    id=file_id,
                    acquisition_id=acquisition_id,
                    role=role,
                    label=label,
                    name=label,
                    size=1,
                    sha256="0",
                    storage_key=f"acquisitions/{acquisition_id}/{file_id}",
                    state="accepted",
                    judgement={},
                    created_by="key_test",
                )
            )
    return acquisition_id


def queued_job(database: Database, acquisition_id: str | None = None, webhook: dict[str, Any] | None = None) -> str:
    """A queued job's row with its first event, without a workflow."""
    job_id = new_id("job")
    owner = acquisition_id or acquisition(database)
    with database.session() as session:
        settings = JobSettings().on(session.get_one(Acquisition, owner))
        session.add(
            Job(
                id=job_id,
                acquisition_id=owner,
                settings=settings,
                priority=5,
                state="queued",
                request_hash="",
                correlation_id="",
                created_by="key_test",
                webhook=webhook,
            )
        )
        append_event(session, job_id, "state", {"state": "queued", "starts": 0})
    return job_id


def row(database: Database, job_id: str) -> Job:
    """The job as the database has it."""
    with database.session() as session:
        return session.get_one(Job, job_id)


def events(database: Database, job_id: str) -> list[JobEvent]:
    """The job's events in order."""
    with database.session() as session:
        return list(session.scalars(sa.select(JobEvent).where(JobEvent.job_id == job_id).order_by(JobEvent.seq)))
