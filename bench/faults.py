"""``python -m bench.faults``: jobs over HTTP while workers, stages and the API are killed at random; none may be lost.

Each kill is ``kill -9`` of one process: of a worker, of a stage's process, or of the API, at random times from a fixed
seed. A takeover is the time from a worker's death to the next start of the job that it ran. The default stages are the
real ones; with ``--stage-command`` others stand in, as where a thousand jobs are run.
"""

from __future__ import annotations

import math
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from argparse import ArgumentParser, Namespace
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from bench.record import keep
from bench.sample import SAMPLE
from bench.service.serving import COMMAND
from specimap_client import Client, Retries
from specimap_infra.database import Database, utc_now
from specimap_infra.migrate import migrate
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.tables import FINAL_STATES, Job, JobEvent
from specimap_service.auth.keys import new_key
from specimap_workers.reaper import burier
from specimap_workers.supervisor import Supervisor

MIX = {"worker": 5, "stage": 4, "api": 1}
"""What is killed how often."""


class Api:
    """The API's process on one port, killed and started again."""

    def __init__(self, port: int) -> None:
        self._environment = {**os.environ, "SPECIMAP_PORT": str(port)}
        self._process = self._start()

    def kill(self) -> None:
        """Kill it, and start it again."""
        self.end()
        self._process = self._start()

    def end(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([*COMMAND, "--no-worker"], env=self._environment, stdout=subprocess.DEVNULL)


def main() -> None:
    """Run, print what was found, and keep it; the status is 1 where a job was lost."""
    parser = ArgumentParser(prog="python -m bench.faults", description=__doc__)
    parser.add_argument("--jobs", type=int, default=30)
    parser.add_argument("--slots", type=int, default=2, help="workers")
    parser.add_argument("--gap", type=float, default=3.0, help="mean seconds between two kills")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60, help="longest time of kills; then the rest may end")
    parser.add_argument("--database-url", default="", help="an empty PostgreSQL database; by default SQLite")
    parser.add_argument("--photos", type=Path, default=SAMPLE / "rgb")
    parser.add_argument("--cube", type=Path, default=SAMPLE / "hsi" / "hsi.hdr")
    parser.add_argument("--stage-command", default="", help="a program that stands in for the stages")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="specimap-faults-") as folder:
        os.environ |= {"SPECIMAP_DATA_DIR": folder, "SPECIMAP_LOG_LEVEL": "warning"}
        if options.database_url:
            os.environ["SPECIMAP_DATABASE_URL"] = options.database_url
        if options.stage_command:
            os.environ["SPECIMAP_SANDBOX"] = "off"
        figures = measure(load_settings(), options)
    for name, value in figures.items():
        print(f"{name}: {value}")
    print(f"Kept in {keep('faults', figures)}")
    sys.exit(figures["states"] != {"succeeded": options.jobs})


def measure(settings: ServiceSettings, options: Namespace) -> dict[str, Any]:
    """Submit the jobs, kill until all have ended, and count."""
    database = Database.open(settings.database)
    migrate(database)
    row, key = new_key("bench", ["upload", "read"], project_id=DEFAULT_PROJECT, rate_per_minute=10**9)
    with database.session() as session:
        session.add(row)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    api = Api(port)
    given = ("--stage-command", options.stage_command) if options.stage_command else ()
    supervisor = Supervisor(options.slots, given, burier(settings))
    supervisor.start()
    start = time.monotonic()
    try:
        submitting = threading.Thread(target=submit, args=(port, key, options))
        submitting.start()
        kills, deaths = kill_at_random(database, api, options)
        submitting.join(60)
        deadline = time.monotonic() + options.minutes * 60
        while not all_ended(database, options.jobs) and time.monotonic() < deadline:
            time.sleep(0.5)
        seconds = time.monotonic() - start
    finally:
        supervisor.stop()
        api.end()
    figures = count(database, deaths) | {"kills": dict(kills), "seconds": round(seconds, 1)}
    figures |= {name: getattr(options, name) for name in ("jobs", "slots", "gap", "seed", "minutes")}
    figures |= {"database": database.engine.dialect.name, "real_stages": not options.stage_command}
    database.close()
    return figures


def submit(port: int, key: str, options: Namespace) -> None:
    """Submit all jobs; each has an acquisition of its own where the stages are the real ones."""
    patient = Retries(attempts=100, first_s=0.2, cap_s=2.0)
    with Client(f"http://127.0.0.1:{port}", key, retries=patient) as client:
        acquisition = ""
        for number in range(options.jobs):
            if not acquisition or not options.stage_command:
                acquisition = client.acquisitions.create(f"bench-{number}").id
                client.acquisitions.upload(acquisition, photos=sorted(options.photos.glob("*.jpg")), cube=options.cube)
            client.jobs.submit(acquisition, idempotency_key=f"bench-{options.seed}-{number}")


def kill_at_random(database: Database, api: Api, options: Namespace) -> tuple[Counter[str], list[tuple[str, Any]]]:
    """Kill until all jobs have ended; what was killed how often, and the running jobs of workers with their deaths."""
    rng, kills, deaths = random.Random(options.seed), Counter[str](), list[tuple[str, Any]]()
    end = time.monotonic() + options.minutes * 60
    while time.monotonic() < end and not all_ended(database, options.jobs):
        time.sleep(rng.expovariate(1 / options.gap))
        (what,) = rng.choices(list(MIX), list(MIX.values()))
        if what == "api":
            api.kill()
            kills[what] += 1
            continue
        workers = children(os.getpid(), "specimap_workers")
        stages = [pid for worker in workers for pid in children(worker, "")]
        found = sorted(workers if what == "worker" else stages)
        if not found:
            continue
        pid = rng.choice(found)
        executor = executor_of(pid) if what == "worker" else None
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            kills[what] += 1
            if executor:
                with database.session() as session:
                    held = session.scalars(sa.select(Job.id).where(Job.executor == executor, Job.state == "running"))
                    deaths += [(job, utc_now()) for job in held]
    return kills, deaths


def all_ended(database: Database, jobs: int) -> bool:
    """Whether so many jobs have ended."""
    with database.session() as session:
        return session.scalar(sa.select(sa.func.count()).where(Job.state.in_(FINAL_STATES))) == jobs


def count(database: Database, deaths: list[tuple[str, Any]]) -> dict[str, Any]:
    """States of the jobs, why some failed, how often they were set back, and how long takeovers took."""
    takeovers = []
    with database.session() as session:
        jobs = list(session.scalars(sa.select(Job)))
        for job_id, died in deaths:
            query = sa.select(JobEvent).where(JobEvent.job_id == job_id, JobEvent.type == "state", JobEvent.at > died)
            starts = [e for e in session.scalars(query.order_by(JobEvent.seq)) if e.data["state"] == "running"]
            takeovers += [(starts[0].at - died).total_seconds()] if starts else []
    takeovers.sort()
    return {
        "states": dict(Counter(job.state for job in jobs)),
        "failures": [job.error for job in jobs if job.state == "failed"],
        "most_starts": max(job.starts for job in jobs),
        "takeovers": len(takeovers),
        "takeover_s": {str(q): round(takeovers[math.ceil(q * (len(takeovers) - 1))], 2) for q in (0.5, 0.99, 1)}
        if takeovers
        else {},
    }


def children(parent: int, word: str) -> list[int]:
    """Processes whose parent is that one and whose command holds the word."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError):
            above = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if above == parent and word in (entry / "cmdline").read_text():
                found.append(int(entry.name))
    return found


def executor_of(pid: int) -> str | None:
    """The name that a worker was started with."""
    with suppress(OSError, ValueError):
        words = (Path("/proc") / str(pid) / "cmdline").read_text().split("\0")
        return words[words.index("--executor") + 1]
    return None


if __name__ == "__main__":
    main()
