"""Workers without stages: each claims a job as a worker does, tells of its progress, ends it, and claims the next."""

from __future__ import annotations

import multiprocessing
import random
import threading
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import sqlalchemy as sa
from dbos import DBOSClient

from specimap_infra import jobs
from specimap_infra.database import Database, database_seconds
from specimap_infra.queue import APPLICATION_VERSION, JOBS, queue_client
from specimap_infra.tables import Lease

PROCESSES = 2
PATIENCE_SECONDS = 180
HEARTBEAT_SECONDS = 2.0


@dataclass(frozen=True)
class Pace:
    """How each claimer works: seconds of a job, and of them between two events; 0 and 0: the next claim at once."""

    job_s: float
    event_s: float


STORM = Pace(0, 0)
STEADY = Pace(10.0, 1.0)
"""A tenth of a job a second of a hundred workers, with an event a second each."""


@dataclass
class Seen:
    """Seconds of each claim and of each write of an event, by all claimers; and errors by kind."""

    claims: list[float] = field(default_factory=list)
    events: list[float] = field(default_factory=list)
    errors: dict[str, int] = field(default_factory=dict)


@contextmanager
def claiming(url: str, claimers: int, pace: Pace) -> Iterator[Seen]:
    """Let claimers work during the block, from processes of their own; complete when the block has ended."""
    seen, context = Seen(), multiprocessing.get_context("spawn")
    shares = [claimers // PROCESSES + (k < claimers % PROCESSES) for k in range(PROCESSES)]
    started: list[tuple[Any, Connection]] = []
    for share in filter(None, shares):
        here, there = context.Pipe()
        process = context.Process(target=_run, args=(url, share, pace, there), daemon=True)
        process.start()
        started.append((process, here))
    try:
        for _, here in started:
            if not here.poll(PATIENCE_SECONDS) or here.recv() != "ready":
                raise RuntimeError("the claimers do not start")
        for _, here in started:
            here.send("go")
        yield seen
        for _, here in started:
            here.send("stop")
        for _, here in started:
            if not here.poll(PATIENCE_SECONDS):
                raise RuntimeError("the claimers do not stop")
            found: Seen = here.recv()
            seen.claims += found.claims
            seen.events += found.events
            for name, count in found.errors.items():
                seen.errors[name] = seen.errors.get(name, 0) + count
    finally:
        for process, _ in started:
            process.kill()
            process.join()


def _run(url: str, claimers: int, pace: Pace, there: Connection) -> None:
    # A connection each, as of a worker's thread that claims; and of the same process its other writes.
    database = Database.open(url, pool_size=claimers, overflow=0)
    client, seen, stop = queue_client(database.engine), Seen(), threading.Event()
    queue = client._sys_db.get_queue(JOBS)
    go = threading.Event()
    threads = [
        threading.Thread(target=_work, args=(database, client, queue, pace, seen, go, stop), daemon=True)
        for _ in range(claimers)
    ]
    for thread in threads:
        thread.start()
    there.send("ready")
    there.recv()
    go.set()
    there.recv()
    stop.set()
    for thread in threads:
        thread.join(30)
    there.send(seen)


def _work(
    database: Database,
    client: DBOSClient,
    queue: Any,
    pace: Pace,
    seen: Seen,
    go: threading.Event,
    stop: threading.Event,
) -> None:
    executor = f"bench:0:{uuid.uuid4().hex[:12]}"
    go.wait()
    # Not all at the same moment, where they work at a pace.
    stop.wait(random.uniform(0, pace.job_s))
    while not stop.is_set():
        try:
            job_id, took = claim(database, client, queue, executor)
            if job_id is None:
                stop.wait(0.2)
                continue
            seen.claims.append(took)
            _do(database, job_id, executor, pace, seen, stop)
        except Exception as error:
            name = type(error.__cause__ or error).__name__
            seen.errors[name] = seen.errors.get(name, 0) + 1
            stop.wait(0.5)


def claim(database: Database, client: DBOSClient, queue: Any, executor: str) -> tuple[str | None, float]:
    """Claim a job as the engine and then a worker do; its id, if there was one, and the seconds that both took."""
    start = time.perf_counter()
    claimed, _ = client._sys_db.start_queued_workflows(
        queue, executor, APPLICATION_VERSION, None, owner_xid=uuid.uuid4().hex
    )
    if not claimed:
        return None, 0.0
    with database.session() as session:
        jobs.claim(session, claimed[0], executor)
    return claimed[0], time.perf_counter() - start


def _do(database: Database, job_id: str, executor: str, pace: Pace, seen: Seen, stop: threading.Event) -> None:
    end = time.monotonic() + pace.job_s
    beat = 0.0
    while time.monotonic() < end and not stop.is_set():
        stop.wait(pace.event_s)
        start = time.perf_counter()
        with database.session() as session:
            jobs.report_progress(session, job_id, executor, "adjust", 0.5)
        seen.events.append(time.perf_counter() - start)
        if time.monotonic() > beat:
            beat = time.monotonic() + HEARTBEAT_SECONDS
            _renew(database, executor)
    with database.session() as session:
        jobs.finish(session, job_id, executor, "succeeded")


def _renew(database: Database, executor: str) -> None:
    now = database_seconds(database.engine)
    values = {"executor": executor, "host": "bench", "kind": "cpu", "started": now, "heartbeat": now}
    with database.session() as session:
        renewed = sa.update(Lease).where(Lease.executor == executor).values(heartbeat=now).returning(Lease.executor)
        if session.execute(renewed).first() is None:
            session.execute(sa.insert(Lease).values(**values))
        session.scalars(sa.select(Lease.executor)).all()
