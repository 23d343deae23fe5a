"""A full queue: acquisitions with the rows of their files, and queued jobs with their workflows, by bulk insert."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from dbos import DBOSClient
from sqlalchemy.orm import Session

from specimap_infra.database import Database, utc_now
from specimap_infra.ids import new_id
from specimap_infra.job_schemas import JobSettings
from specimap_infra.projects import DEFAULT_PROJECT, new_project
from specimap_infra.queue import JOBS, RUN_JOB, enqueue, queue_client
from specimap_infra.schema_version import engine_schema
from specimap_infra.tables import Acquisition, Base, CloudRow, Job, JobEvent, StoredFile
from specimap_service.auth.keys import new_key

PHOTOS = 24
SMALL = 2
"""Acquisitions of the small project, which are the oldest: its jobs are the last that a list finds."""
BATCH = 2000


@dataclass(frozen=True)
class Full:
    """What was filled in."""

    acquisitions: list[str]
    """Of the large project, the oldest first."""
    jobs: list[str]
    small_key: str
    """A key of the small project, which may read."""


def fill(database: Database, acquisitions: int, jobs: int) -> Full:
    """Fill an empty database. Each acquisition has as many jobs as every other, and a finished job with a cloud."""
    client = queue_client(database.engine)
    # As workers register it, of which none has been started.
    client.register_queue(JOBS, worker_concurrency=1)
    with database.session() as session:
        project = new_project(session, "small").id
        small_row, small_key = new_key("small", ["read"], project_id=project, rate_per_minute=10**9)
        session.add(small_row)
    ids = [new_id("acq") for _ in range(acquisitions)]
    now = utc_now()
    common: dict[str, Any] = {"created_by": "key_bench", "created_at": now}
    with database.session() as session:
        _insert(
            session,
            Acquisition,
            [
                {
                    **common,
                    "id": id,
                    "project_id": project if k < SMALL else DEFAULT_PROJECT,
                    "specimen_id": f"S-{k}",
                    "accession_number": f"A-{k}",
                    "dictionary": "DICT_4X4_50",
                    "edge_mm": 6.8,
                    "notes": "",
                }
                for k, id in enumerate(ids)
            ],
        )
        _insert(session, StoredFile, [file | common for id in ids for file in _files(id)])
        done = [_job(id, "succeeded", "key_bench") for id in ids]
        queued = [_job(id, "queued", "key_bench") for id in ids for _ in range(jobs // acquisitions)]
        _insert(session, Job, done + queued)
        _insert(session, JobEvent, [_event(job["id"], job["state"]) for job in done + queued])
        _insert(session, CloudRow, [_cloud(job["id"], job["acquisition_id"]) for job in done])
        _enqueue(client, session, [job["id"] for job in queued])
    _analyse(database)
    return Full(ids[SMALL:], [job["id"] for job in queued], small_key)


def _insert(session: Session, table: type[Base], rows: list[dict[str, Any]]) -> None:
    for at in range(0, len(rows), BATCH):
        session.execute(sa.insert(table), rows[at : at + BATCH])


def _files(acquisition: str) -> list[dict[str, Any]]:
    labels = [f"photo-{n:04d}.jpg" for n in range(1, PHOTOS + 1)] + ["cube.hdr", "cube.raw"]
    files = []
    for label in labels:
        id = new_id("file")
        files.append(
            {
                "id": id,
                "acquisition_id": acquisition,
                "role": label.split("-")[0].split(".")[0],
                "label": label,
                "name": label,
                "size": 1,
                "sha256": "0",
                "storage_key": f"acquisitions/{acquisition}/{id}",
                "state": "accepted",
                "judgement": {},
            }
        )
    return files


def _job(acquisition: str, state: str, owner: str) -> dict[str, Any]:
    now = utc_now()
    return {
        "id": new_id("job"),
        "acquisition_id": acquisition,
        "settings": JobSettings(dictionary="DICT_4X4_50", edge_mm=6.8).model_dump(),
        "priority": 5,
        "state": state,
        "request_hash": "",
        "correlation_id": "bench",
        "seconds": {},
        "finished_at": now if state == "succeeded" else None,
        "created_at": now,
        "created_by": owner,
    }


def _event(job: str, state: str) -> dict[str, Any]:
    return {"job_id": job, "seq": 1, "type": "state", "data": {"state": state, "starts": 0}, "at": utc_now()}


def _cloud(job: str, acquisition: str) -> dict[str, Any]:
    return {
        "id": new_id("cloud"),
        "job_id": job,
        "acquisition_id": acquisition,
        "prefix": f"jobs/{job}/register/att",
        "points": 300_000,
        "bands": 290,
        "size": 1,
        "report": {},
        "created_at": utc_now(),
    }


def _enqueue(client: DBOSClient, session: Session, jobs: list[str]) -> None:
    """Enqueue the first by the engine, and the others as copies of its row: one by one, that would take minutes."""
    enqueue(client, session, JOBS, RUN_JOB, jobs[0], 5)
    connection = session.connection()
    schema = engine_schema(connection.dialect)
    for name in ("workflow_status", "workflow_input"):
        table = sa.Table(name, sa.MetaData(), schema=schema, autoload_with=connection)
        row = connection.execute(sa.select(table).where(table.c.workflow_uuid == jobs[0])).mappings().one_or_none()
        if row is None:
            continue
        copies = []
        for k, job in enumerate(jobs[1:], 1):
            copy = {column: _renamed(value, jobs[0], job) for column, value in row.items()}
            if "created_at" in copy:
                copy["created_at"] += k
            copies.append(copy)
        for at in range(0, len(copies), BATCH):
            connection.execute(sa.insert(table), copies[at : at + BATCH])


def _renamed(value: Any, old: str, new: str) -> Any:
    return value.replace(old, new) if isinstance(value, str) else value


def _analyse(database: Database) -> None:
    """Bring the planner's statistics up to date, as the server does by itself after some time."""
    with database.engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        connection.exec_driver_sql("ANALYZE")
