"""Jobs and workers for tests: an acquisition in the database and the storage, and real worker processes."""

from __future__ import annotations

import hashlib
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.database import Database
from specimap_infra.ids import new_id
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.queue import JOBS, RUN_JOB, enqueue, queue_client
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import FINAL_STATES, Acquisition, CloudRow, Job, JobEvent, Lease, StoredFile
from tests.support.databases import create_tables
from tests.support.places import SUPPORT

STAGE_SCRIPT = "stage_script.py"
HELD = f"{sys.executable} {SUPPORT / STAGE_SCRIPT}"
"""The real stages, held at their beginning while a file of their name lies in HOLD_FOLDER."""
QUICK = f"{HELD} quick"
"""Stages, held likewise, that do nothing but leave what the next one looks for."""


def until(what: Callable[[], Any], seconds: float, why: str) -> Any:
    """Poll until ``what`` gives something true; gives that."""
    deadline = time.monotonic() + seconds
    while True:
        found = what()
        if found:
            return found
        assert time.monotonic() < deadline, f"not within {seconds} s: {why}"
        time.sleep(0.02)


@dataclass
class Shop:
    """A database and a storage with jobs, and the worker processes on them."""

    settings: ServiceSettings
    environment: Mapping[str, str]
    database: Database
    storage: Storage
    hold: Path
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)

    # ---- acquisitions and jobs ------------------------------------------------------------------------

    def acquisition(self, photos: Path, header: Path) -> str:
        """Store photos and an ENVI cube as the API does; gives the acquisition's id."""
        row = Acquisition(
            project_id=DEFAULT_PROJECT,
            id=new_id("acq"),
            specimen_id="S1",
            dictionary="DICT_4X4_50",
            edge_mm=6.8,
            notes="",
            created_by="key_test",
        )
        with self.database.session() as session:
            session.add(row)
        for number, photo in enumerate(sorted(photos.glob("*.jpg")), 1):
            self._file(row.id, photo, "photo", f"photo-{number:04}.jpg")
        self._file(row.id, header, "cube", "cube.hdr")
        (data,) = (p for p in header.parent.glob(f"{header.stem}.*") if p != header)
        self._file(row.id, data, "cube", "cube.raw")
        return row.id

    def _file(self, acquisition: str, path: Path, role: str, label: str) -> None:
        data, name = path.read_bytes(), new_id("file")
        key = f"acquisitions/{acquisition}/{name}"
        self.storage.put(key, data)
        with self.database.session() as session:
            session.add(
                StoredFile(
                    id=name,
                    acquisition_id=acquisition,
                    role=role,
                    label=label,
                    name=path.name,
                    size=len(data),
                    sha256=hashlib.sha256(data).hexdigest(),
                    storage_key=key,
                    state="accepted",
                    judgement={},
                    created_by="key_test",
                )
            )

    def submit(self, acquisition: str, priority: int = 5, **settings: object) -> str:
        """Put a job in the queue."""
        job_id, client = new_id("job"), queue_client(self.database.engine)
        with self.database.session() as session:
            session.add(
                Job(
                    id=job_id,
                    acquisition_id=acquisition,
                    settings=settings,
                    priority=priority,
                    state="queued",
                    request_hash="",
                    correlation_id="test",
                    created_by="key_test",
                )
            )
            session.flush()
            enqueue(client, session, JOBS, RUN_JOB, job_id, priority)
        return job_id

    def job(self, job_id: str) -> Job:
        """The job's row."""
        with self.database.session() as session:
            return session.get_one(Job, job_id)

    def cancel(self, job_id: str) -> None:
        """As the API does."""
        with self.database.session() as session:
            jobs.request_cancel(session, job_id)
        queue_client(self.database.engine).cancel_workflow(job_id)

    def ended(self, job_id: str, seconds: float = 60) -> Job:
        """The job once it has ended."""
        until(lambda: self.job(job_id).state in FINAL_STATES, seconds, f"the end of {job_id}")
        return self.job(job_id)

    def events(self, job_id: str, type: str) -> list[dict[str, Any]]:
        """The job's events of a type, in order."""
        with self.database.session() as session:
            query = sa.select(JobEvent.data).where(JobEvent.job_id == job_id, JobEvent.type == type)
            return list(session.scalars(query.order_by(JobEvent.seq)))

    def ran(self, job_id: str) -> list[str]:
        """The stages that began, in order, one name for each beginning."""
        return [e["stage"] for e in self.events(job_id, "progress") if e["progress"] == 0.0]

    def cloud(self, job_id: str) -> CloudRow:
        """The one result of a job."""
        with self.database.session() as session:
            return session.scalars(sa.select(CloudRow).where(CloudRow.job_id == job_id)).one()

    # ---- workers --------------------------------------------------------------------------------------

    def start(self, command: str = HELD, **options: str) -> subprocess.Popen[bytes]:
        """Start a worker process; it is ready when its lease is there."""
        known = self.leases()
        worker = subprocess.Popen(
            [sys.executable, "-m", "specimap_workers", "--stage-command", command],
            env={**os.environ, **self.environment, "HOLD_FOLDER": str(self.hold), **options},
            start_new_session=True,
        )
        self.workers.append(worker)
        until(lambda: self.leases() - known or worker.poll() is not None, 30, "the worker's lease")
        assert worker.poll() is None
        return worker

    def leases(self) -> set[str]:
        """Executors with a lease."""
        with self.database.session() as session:
            return set(session.scalars(sa.select(Lease.executor)))

    def holding(self, stage: str) -> Path:
        """Hold every stage of that name from now on; unlink what this gives to let it go."""
        path = self.hold / stage
        path.touch()
        return path

    def held(self, stage: str, seconds: float = 40) -> int:
        """Wait until a process is held at the beginning of a stage; gives its process id."""
        note = self.hold / f"{stage}.pid"

        def living() -> int:
            try:
                pid = int(note.read_text("ascii"))
                os.kill(pid, 0)
            except (OSError, ValueError):
                return 0
            return pid

        return int(until(living, seconds, f"stage {stage}"))

    def freeze(self, worker: subprocess.Popen[bytes]) -> None:
        """Stop a worker's process between two of its transactions: SQLite has one writer at a time, and one that is
        stopped while it writes stops all others, whatever they do."""

        def stopped_idle() -> bool:
            worker.send_signal(signal.SIGSTOP)
            # A process stops when it next would run: its state tells when it has.
            state = Path(f"/proc/{worker.pid}/stat")
            until(lambda: state.read_text().rsplit(")", 1)[1].split()[0] == "T", 5, "the stop")
            if self._writable():
                return True
            worker.send_signal(signal.SIGCONT)
            return False

        until(stopped_idle, 20, "a stop between transactions")

    def _writable(self) -> bool:
        path = self.database.engine.url.database
        assert path is not None
        with closing(sqlite3.connect(path, timeout=0.2, isolation_level=None)) as connection:
            try:
                connection.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError:
                return False
            connection.execute("ROLLBACK")
            return True

    def stop(self) -> None:
        """Kill all workers; none of their processes outlives them."""
        for worker in self.workers:
            for number in (signal.SIGCONT, signal.SIGKILL):
                if worker.poll() is None:
                    worker.send_signal(number)
            worker.wait(10)


@contextmanager
def shop(folder: Path, **given: object) -> Iterator[Shop]:
    """Open one; ``given`` are settings."""
    values = {
        "data_dir": folder,
        "log_level": "warning",
        "heartbeat_seconds": 0.6,
        "lease_seconds": 3.0,
        # Its stages are held by files that lie where a confined process reaches nothing.
        "sandbox": "off",
        **given,
    }
    environment = {f"SPECIMAP_{name.upper()}": str(value) for name, value in values.items()}
    settings = load_settings(**values)
    database = Database.open(settings.database)
    create_tables(database)
    hold = folder / "hold"
    hold.mkdir(parents=True)
    opened = Shop(settings, environment, database, Storage.open(settings), hold)
    try:
        yield opened
    finally:
        opened.stop()
        database.close()


def assert_all_succeed(yard: Shop, ids: Sequence[str], seconds: float = 240) -> None:
    """Wait for the end of all jobs that there are: those of ``ids``, each succeeded with one result."""

    def ended() -> bool:
        with yard.database.session() as session:
            query = sa.select(sa.func.count()).select_from(Job).where(Job.state.in_(FINAL_STATES))
            return session.scalar(query) == len(ids)

    until(ended, seconds, "the end of all jobs")
    with yard.database.session() as session:
        assert Counter(session.scalars(sa.select(Job.state))) == {"succeeded": len(ids)}
        assert Counter(session.scalars(sa.select(CloudRow.job_id))) == dict.fromkeys(ids, 1)


def processes_of(words: Sequence[str]) -> list[int]:
    """Ids of the processes whose command line holds all words."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                line = (entry / "cmdline").read_bytes().decode(errors="replace")
            except OSError:
                continue
            if all(word in line for word in words):
                found.append(int(entry.name))
    return found
