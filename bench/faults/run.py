"""One run: jobs are submitted, what works on them is killed, and what became of them is counted."""

from __future__ import annotations

import math
import os
import random
import socket
import sys
import threading
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from datetime import datetime
from typing import Any

import sqlalchemy as sa

from bench.faults.processes import Api, Machine, children, executor_of, hogs, kill
from specimap_client import Client, Retries
from specimap_infra.database import Database, utc_now
from specimap_infra.migrate import migrate
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import FINAL_STATES, Job, JobEvent
from specimap_service.auth.keys import new_key

MIX = {"worker": 5, "stage": 4, "api": 1, "machine": 3}
"""What is killed how often; machines only where there are several."""
SAID_SECONDS = 60.0

Death = tuple[str, str, datetime]
"""What was killed, a job that ran there, and when."""


def measure(settings: ServiceSettings, options: Namespace, stage_command: str) -> dict[str, Any]:
    """Submit the jobs, kill until all have ended, and count."""
    database = Database.open(settings.database)
    migrate(database)
    row, key = new_key("bench", ["upload", "read"], project_id=DEFAULT_PROJECT, rate_per_minute=10**9)
    with database.session() as session:
        session.add(row)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    api = Api(port)
    scratch = settings.data_dir / "machines"
    machines = [Machine(scratch / str(k), options.slots, stage_command) for k in range(options.machines)]
    start = time.monotonic()
    try:
        with hogs(options.hogs):
            submitting = threading.Thread(target=submit, args=(port, key, options))
            submitting.start()
            kills, deaths = kill_at_random(database, api, machines, options)
            submitting.join(60)
            deadline = time.monotonic() + options.minutes * 60
            while not all_ended(database, options.jobs) and time.monotonic() < deadline:
                time.sleep(0.5)
            seconds = time.monotonic() - start
    finally:
        for machine in machines:
            machine.end()
        api.end()
    figures = count(database, deaths) | {"kills": dict(kills), "seconds": round(seconds, 1)}
    names = ("jobs", "slots", "machines", "gap", "seed", "minutes", "hogs")
    figures |= {name: getattr(options, name) for name in names}
    figures |= {"database": database.engine.dialect.name, "real_stages": not stage_command}
    figures |= {"load_after": round(os.getloadavg()[0], 2), "lease_seconds": settings.lease_seconds}
    database.close()
    return figures


def submit(port: int, key: str, options: Namespace) -> None:
    """Submit all jobs; each has an acquisition of its own where the stages are the real ones."""
    patient = Retries(attempts=100, first_s=0.2, cap_s=2.0)
    with Client(f"http://127.0.0.1:{port}", key, retries=patient) as client:
        acquisition = ""
        for number in range(options.jobs):
            if not acquisition or not options.stand_in:
                acquisition = client.acquisitions.create(f"bench-{number}").id
                client.acquisitions.upload(acquisition, photos=sorted(options.photos.glob("*.jpg")), cube=options.cube)
            client.jobs.submit(acquisition, idempotency_key=f"bench-{options.seed}-{number}")


def kill_at_random(
    database: Database, api: Api, machines: Sequence[Machine], options: Namespace
) -> tuple[Counter[str], list[Death]]:
    """Kill until all jobs have ended; what was killed how often, and the running jobs of workers with their deaths."""
    rng, kills, deaths = random.Random(options.seed), Counter[str](), list[Death]()
    mix = {what: share for what, share in MIX.items() if what != "machine" or len(machines) > 1}
    end, said = time.monotonic() + options.minutes * 60, time.monotonic()
    while time.monotonic() < end and not all_ended(database, options.jobs):
        wake = time.monotonic() + rng.expovariate(1 / options.gap)
        while (now := time.monotonic()) < wake and not all_ended(database, options.jobs):
            time.sleep(min(0.5, wake - now))
        if time.monotonic() - said > SAID_SECONDS:
            said = time.monotonic()
            print(f"{states(database)}, killed: {dict(kills)}", file=sys.stderr, flush=True)
        (what,) = rng.choices(list(mix), list(mix.values()))
        if what == "api":
            api.kill()
            kills[what] += 1
            continue
        machine = rng.choice(machines)
        workers = machine.workers()
        victims = workers if what == "worker" else [pid for worker in workers for pid in children(worker, "")]
        if not victims:
            continue
        pid = rng.choice(sorted(victims))
        executors = [executor_of(pid)] if what == "worker" else []
        if what == "machine":
            executors = [executor_of(worker) for worker in workers]
            died = utc_now()
            machine.kill()
        else:
            died = utc_now()
            if not kill(pid):
                continue
        kills[what] += 1
        deaths += [(what, job, died) for job in held_by(database, executors)]
    return kills, deaths


def held_by(database: Database, executors: Sequence[str | None]) -> list[str]:
    """Jobs that these workers ran."""
    with database.session() as session:
        return list(session.scalars(sa.select(Job.id).where(Job.executor.in_(executors), Job.state == "running")))


def states(database: Database) -> dict[str, int]:
    """How many jobs are in which state."""
    with database.session() as session:
        return dict(session.execute(sa.select(Job.state, sa.func.count()).group_by(Job.state)).tuples().all())


def all_ended(database: Database, jobs: int) -> bool:
    """Whether so many jobs have ended."""
    return sum(number for state, number in states(database).items() if state in FINAL_STATES) == jobs


def count(database: Database, deaths: list[Death]) -> dict[str, Any]:
    """States of the jobs, why some failed, how often they were set back, and how long takeovers took."""
    takeovers: dict[str, list[float]] = {}
    with database.session() as session:
        jobs = list(session.scalars(sa.select(Job)))
        for what, job_id, died in deaths:
            query = sa.select(JobEvent).where(JobEvent.job_id == job_id, JobEvent.type == "state", JobEvent.at > died)
            starts = [e for e in session.scalars(query.order_by(JobEvent.seq)) if e.data["state"] == "running"]
            if starts:
                takeovers.setdefault(what, []).append((starts[0].at - died).total_seconds())
    return {
        "states": dict(Counter(job.state for job in jobs)),
        "failures": [job.error for job in jobs if job.state == "failed"],
        "most_starts": max((job.starts for job in jobs), default=0),
        "takeovers": {what: percentiles(seconds) for what, seconds in takeovers.items()},
    }


def percentiles(seconds: list[float]) -> dict[str, float]:
    """How many, and the median, the 99th percentile and the longest."""
    ordered = sorted(seconds)
    at = {str(q): round(ordered[math.ceil(q * len(ordered)) - 1], 2) for q in (0.5, 0.99, 1)}
    return {"number": len(ordered), **at}
