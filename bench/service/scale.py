"""The service with a full queue: lists, submissions, claims and events, polls and connections, a hundred workers."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from bench.service.claimers import STEADY, STORM, Pace, claiming
from bench.service.databases import connect, postgres_url, postgres_version
from bench.service.full_queue import Full, fill
from bench.service.options import Options
from bench.service.serving import Served, serving
from bench.service.wire import load, request
from specimap_core.json_text import json_text
from specimap_infra import jobs
from specimap_infra.database import Database

ACQUISITIONS = 1000
JOBS = 10_000
SECONDS = 4.0
CLAIM_SECONDS = 6.0
EVENTS = 150
WORKERS = 100
FIRST_MINUTE = 65.0
"""In it, the engine of a worker looks for schedules every second, and then every half minute."""
IDLE_SECONDS = 20.0
API_CLIENTS = 100
NAMES = {
    "first page": "list of jobs, first page of 100",
    "deep page": "the same, a page near its end",
    "state": "the same, of one state",
    "acquisition": "jobs of one acquisition",
    "small project": "a project of 20 jobs, all its jobs",
    "small clouds": "the same, all its clouds",
    "acquisitions": "list of acquisitions, first page of 100",
    "status": "state of one queued job",
    "submit": "submission of a job",
    "claim": "claim of a job by a worker",
    "event": "an event, from the worker's write to the listener",
}


def bench_scale(work: Path, options: Options) -> dict[str, Any]:
    """Measure on both databases, the worst of ``repeats``; what workers and connections take on PostgreSQL alone."""
    figures: dict[str, Any] = {"acquisitions": ACQUISITIONS, "jobs": JOBS, "postgres_version": postgres_version()}
    figures["runs"] = {"sqlite": _measured(work / "scale-sqlite", {}, options.repeats)}
    if figures["postgres_version"] is None:
        return figures
    with postgres_url() as url:
        figures["runs"]["postgresql"] = _measured(
            work / "scale-postgresql", {"database_url": url}, options.repeats, figures
        )
    with postgres_url() as url:
        figures["idle"] = _idle(work / "scale-idle", url)
    with connect() as server:
        row = server.execute("SHOW max_connections").fetchone()
        assert row is not None
        figures["max_connections"] = int(row[0])
    return figures


def _measured(folder: Path, given: dict[str, str], repeats: int, figures: dict[str, Any] | None = None) -> Any:
    with serving(folder, given=given) as served:
        database = Database.open(served.settings.database)
        full = fill(database, ACQUISITIONS, JOBS)
        runs: dict[str, list[dict[str, float]]] = {name: [] for name in NAMES}
        for _ in range(repeats):
            for name, requests in _requests(served, full).items():
                cpu = served.cpu_seconds()
                run = load(served.address, requests, 1, SECONDS).as_dict()
                run["cpu_ms"] = round((served.cpu_seconds() - cpu) * 1e3 / run["requests"], 2)
                runs[name].append(run)
            with claiming(served.settings.database, 1, STORM) as seen:
                time.sleep(SECONDS)
            runs["claim"].append(_percentiles(seen.claims))
            runs["event"].append(_percentiles(_delays(served, database, full.jobs[-1])))
        if figures is not None:
            figures["api_connections"] = _most_connections(served, full)
            figures["crowds"] = {
                f"{name} {count}": _crowd(served, full, count, pace)
                for name, count, pace in (
                    ("storm", 10, STORM),
                    ("storm", WORKERS, STORM),
                    ("steady", WORKERS, STEADY),
                )
            }
        database.close()
    return runs


def _requests(served: Served, full: Full) -> dict[str, list[bytes]]:
    def get(path: str, key: str = "") -> bytes:
        return request(served.address, path, {"Authorization": f"Bearer {key or served.key}"})

    headers = {"Authorization": served.bearer, "Content-Type": "application/json"}
    step = len(full.acquisitions) // 100
    return {
        "first page": [get("/v1/jobs?limit=100")],
        "deep page": [get(f"/v1/jobs?limit=100&after={full.jobs[300]}")],
        "state": [get("/v1/jobs?limit=100&state=queued")],
        "acquisition": [get(f"/v1/jobs?acquisition_id={id}") for id in full.acquisitions[::step]],
        "small project": [get("/v1/jobs", full.small_key)],
        "small clouds": [get("/v1/clouds", full.small_key)],
        "acquisitions": [get("/v1/acquisitions?limit=100")],
        "status": [get(f"/v1/jobs/{id}") for id in full.jobs[:: JOBS // 100]],
        "submit": [
            request(served.address, "/v1/jobs", headers, "POST", json_text({"acquisition_id": id}).encode())
            for id in full.acquisitions[::step]
        ],
    }


def _percentiles(seconds: list[float]) -> dict[str, float]:
    p50, p99 = np.percentile(seconds, [50, 99]) * 1e3
    return {"requests": len(seconds), "p50_ms": round(float(p50), 3), "p99_ms": round(float(p99), 3)}


# ---- events -------------------------------------------------------------------------------------------


def _delays(served: Served, database: Database, job_id: str) -> list[float]:
    """Seconds from the beginning of each write of an event to its arrival at a listener."""
    executor, came = "bench:0:events", dict[int, float]()
    with database.session() as session:
        jobs.claim(session, job_id, executor)
        first = jobs.append_event(session, job_id, "log", {"level": "info", "message": "", "data": {}})
    with _listening(served, job_id, first, came) as followed:
        written: dict[int, float] = {}
        pauses = np.random.default_rng(0).uniform(0.01, 0.06, EVENTS)
        for number, pause in enumerate(pauses, first + 1):
            time.sleep(pause)
            written[number] = time.perf_counter()
            with database.session() as session:
                jobs.report_progress(session, job_id, executor, "adjust", 0.5)
        followed(first + EVENTS)
    return [came[number] - at for number, at in written.items()]


@contextmanager
def _listening(served: Served, job_id: str, after: int, came: dict[int, float]) -> Iterator[Callable[[int], None]]:
    """Follow a job's events; ``came`` has the time of each. What this gives waits for one."""
    headers = {"Authorization": served.bearer, "Last-Event-ID": str(after)}
    stream = socket.create_connection(served.address, 60)
    stream.sendall(request(served.address, f"/v1/jobs/{job_id}/events", headers))
    arrived = threading.Condition()

    def read() -> None:
        for line in stream.makefile("rb"):
            if line.startswith(b"id: "):
                with arrived:
                    came[int(line[4:])] = time.perf_counter()
                    arrived.notify_all()

    def followed(number: int) -> None:
        with arrived:
            if not arrived.wait_for(lambda: number in came, 60):
                raise RuntimeError(f"event {number} did not come")

    threading.Thread(target=read, daemon=True).start()
    try:
        yield followed
    finally:
        stream.shutdown(socket.SHUT_RDWR)
        stream.close()


# ---- many workers -------------------------------------------------------------------------------------


def _crowd(served: Served, full: Full, claimers: int, pace: Pace) -> dict[str, Any]:
    """What claimers and, meanwhile, a client of the API wait."""
    seconds = CLAIM_SECONDS if pace is STORM else 2 * CLAIM_SECONDS + pace.job_s
    requests = _requests(served, full)
    with claiming(served.settings.database, claimers, pace) as seen:
        if pace is not STORM:
            time.sleep(pace.job_s)
        start = time.perf_counter()
        half = (seconds - (0 if pace is STORM else pace.job_s)) / 2
        listed = load(served.address, requests["first page"], 1, half).as_dict()
        submitted = load(served.address, requests["submit"], 1, half).as_dict()
        took = time.perf_counter() - start + (0 if pace is STORM else pace.job_s)
    return {
        "claimers": claimers,
        "claims_per_second": round(len(seen.claims) / took, 1),
        "claim": _percentiles(seen.claims),
        "event": _percentiles(seen.events) if seen.events else None,
        "list": listed,
        "submit": submitted,
        "errors": seen.errors,
    }


# ---- polls and connections ----------------------------------------------------------------------------


def _most_connections(served: Served, full: Full) -> int:
    """The most connections to the database that the API holds under a load of requests."""
    name, found, stop = served.settings.database.rsplit("/", 1)[1], [0], threading.Event()

    def watch() -> None:
        with connect() as server:
            while not stop.wait(0.05):
                found.append(_backends(server, name))

    watching = threading.Thread(target=watch)
    watching.start()
    load(served.address, _requests(served, full)["status"], API_CLIENTS, SECONDS)
    stop.set()
    watching.join()
    # Of the benchmark itself: it holds what its pool has kept open.
    return max(found) - 1


def _backends(server: Any, database: str) -> int:
    query = "SELECT count(*) FROM pg_stat_activity WHERE datname = %s"
    return int(server.execute(query, [database]).fetchone()[0])


def _idle(folder: Path, url: str) -> dict[str, Any]:
    """What one real worker without work asks of the database."""
    with serving(folder, given={"database_url": url}):
        pass  # it makes the tables
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SPECIMAP_")}
    environment |= {"SPECIMAP_DATABASE_URL": url, "SPECIMAP_DATA_DIR": str(folder), "SPECIMAP_LOG_LEVEL": "warning"}
    worker = subprocess.Popen([sys.executable, "-m", "specimap_workers"], env=environment)
    try:
        with connect(url.rsplit("/", 1)[1]) as server:
            time.sleep(FIRST_MINUTE)
            before, start = _asked(server), time.perf_counter()
            time.sleep(IDLE_SECONDS)
            after, seconds = _asked(server), time.perf_counter() - start
            held = _backends(server, url.rsplit("/", 1)[1]) - 1
    finally:
        worker.terminate()
        worker.wait(30)
    return {
        "connections": held,
        "polls_per_second": round((after["polls"] - before["polls"]) / seconds, 2),
        "transactions_per_second": round((after["transactions"] - before["transactions"]) / seconds, 2),
    }


def _asked(server: Any) -> dict[str, int]:
    """How often the queues and the deliveries have been looked at, and transactions made, all of a database.

    Before it looks for work, each queue's thread reads the queue's row.
    """
    server.execute("SELECT pg_stat_clear_snapshot()")
    scans = "SELECT coalesce(sum(seq_scan + coalesce(idx_scan, 0)), 0) FROM pg_stat_user_tables WHERE relname = %s"
    polls = [int(server.execute(scans, [table]).fetchone()[0]) for table in ("queues", "deliveries")]
    query = "SELECT xact_commit + xact_rollback FROM pg_stat_database WHERE datname = current_database()"
    return {"polls": sum(polls), "transactions": int(server.execute(query).fetchone()[0])}
