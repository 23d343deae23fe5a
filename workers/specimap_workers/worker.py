"""A worker: one process for one slot. It takes jobs from the queue, and takes over what dead workers left."""

from __future__ import annotations

import asyncio
import fcntl
import signal
import socket
import threading
import time
import uuid
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, TextIO

from dbos import DBOS, DBOSConfig

from specimap_core.atomic import remove
from specimap_core.errors import SpecimapError
from specimap_core.reconstruct.backends.environment import BackendSettings
from specimap_infra.database import Database
from specimap_infra.errors import LostLeaseError
from specimap_infra.housekeeping import Housekeeping
from specimap_infra.logs import logger
from specimap_infra.queue import (
    APPLICATION,
    APPLICATION_VERSION,
    EXPORTS,
    JOBS,
    MAKE_EXPORT,
    POLL_SECONDS,
    RUN_JOB,
    JsonSerializer,
    queue_client,
)
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.webhooks import deliver_due, webhook_client
from specimap_workers.exports import run_export
from specimap_workers.job import STAGES, JobRun
from specimap_workers.leases import LeaseKeeper
from specimap_workers.reaper import Reaper
from specimap_workers.stage_process import COMMAND, Processes
from specimap_workers.workspaces import Workspaces

DELIVERY_SECONDS = 1.0
SWEEP_SECONDS = 15.0


class Worker:
    """Everything one worker process holds."""

    def __init__(
        self,
        settings: ServiceSettings,
        backends: BackendSettings,
        *,
        slot: int = 0,
        kind: str = "cpu",
        command: Sequence[str] = COMMAND,
    ) -> None:
        self.settings = settings
        self._backends = backends
        self.executor = f"{socket.gethostname()}:{slot}:{uuid.uuid4().hex[:12]}"
        self._database = Database.open(settings.database)
        self._storage = Storage.open(settings)
        workspaces = Workspaces.of(settings, settings.scratch / "work", self._suffix, backends)
        self._processes = Processes(workspaces, command, memory_bytes=settings.stage_memory_bytes)
        self._kind = kind
        self._stopping = threading.Event()
        self._note: TextIO | None = None

    @property
    def _suffix(self) -> str:
        """How the names of this executor's folders end."""
        return self.executor.rsplit(":", 1)[-1]

    def run(self) -> None:
        """Work until SIGTERM or SIGINT; the database has been migrated.

        Raises:
            DatabaseUnavailableError, StorageUnavailableError: nothing was started then.
        """
        self._storage.check_at_start()
        self._sweep()
        self._register()
        self._configure()
        reaper = Reaper(self._database, queue_client(self._database.engine))
        keeper = LeaseKeeper(
            self._database,
            self.executor,
            kind=self._kind,
            heartbeat_seconds=self.settings.heartbeat_seconds,
            lease_seconds=self.settings.lease_seconds,
            look_after=reaper.look_after,
        )
        keeper.start()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._stopping.set())
        DBOS.listen_queues([JOBS, EXPORTS])
        DBOS.launch()
        for queue in (JOBS, EXPORTS):
            DBOS.register_queue(
                queue, worker_concurrency=1, polling_interval_sec=POLL_SECONDS, on_conflict="always_update"
            )
        logger().info("worker started", executor=self.executor)
        housekeeping = Housekeeping(self._database, self._storage, self.settings, queue_client(self._database.engine))
        housekeeping.start()
        try:
            self._deliver_until_stopped()
        finally:
            # What runs is not waited for: its job goes on elsewhere from the last finished stage.
            DBOS.destroy(workflow_completion_timeout_sec=0)
            reaper.hand_over(self.executor)
            keeper.stop()
            housekeeping.stop()
            logger().info("worker stopped", executor=self.executor)

    def _deliver_until_stopped(self) -> None:
        with webhook_client() as client:
            swept = time.monotonic()
            while not self._stopping.wait(DELIVERY_SECONDS):
                if time.monotonic() - swept > SWEEP_SECONDS:
                    swept = time.monotonic()
                    self._sweep()
                try:
                    deliver_due(self._database, self.settings, client)
                except SpecimapError as error:
                    logger().warning("webhooks not delivered", code=error.code)

    def _configure(self) -> None:
        config: DBOSConfig = {
            "name": APPLICATION,
            "system_database_url": self._database.engine.url.render_as_string(hide_password=False),
            "application_version": APPLICATION_VERSION,
            "executor_id": self.executor,
            "serializer": JsonSerializer(),
            "run_migrations": False,
            "use_listen_notify": True,
            "notification_listener_polling_interval_sec": POLL_SECONDS,
            "log_level": "WARNING",
            "console_log_level": "ERROR",
        }
        DBOS(config=config)

    def _register(self) -> None:
        """Declare the workflows. Their first act is not a step: the worker that takes a job over must claim it anew."""

        @DBOS.step(name="stage", preemptible=True)
        async def stage_step(job_id: str, stage: str) -> dict[str, Any]:
            return await self._job(job_id).stage(stage)

        @DBOS.workflow(name=RUN_JOB, max_recovery_attempts=None)
        async def run_job(job_id: str) -> str:
            job = self._job(job_id)
            self._processes.prepare()
            if not await job.claim():
                return "ended before"
            outcomes: list[dict[str, Any]] = []
            try:
                for stage in STAGES:
                    outcomes.append(await stage_step(job_id, stage))
                    if "error" in outcomes[-1]:
                        break
                return await job.finish(outcomes)
            except LostLeaseError:
                logger().warning("job lost to another worker", job=job_id, executor=self.executor)
                return "lost"
            finally:
                job.clear()

        @DBOS.workflow(name=MAKE_EXPORT, max_recovery_attempts=None)
        async def make_export(export_id: str) -> str:
            stop = threading.Event()
            try:
                await asyncio.to_thread(
                    run_export,
                    export_id,
                    self._database,
                    self._storage,
                    self.settings,
                    self.executor,
                    cancelled=stop.is_set,
                )
            finally:
                stop.set()
            return "done"

        self._workflows = run_job, make_export, stage_step

    def _job(self, job_id: str) -> JobRun:
        return JobRun(
            job_id,
            self.executor,
            database=self._database,
            storage=self._storage,
            settings=self.settings,
            processes=self._processes,
            backends=self._backends,
        )

    def _sweep(self) -> None:
        """Remove work folders of processes of this machine that are gone."""
        work = self.settings.scratch / "work"
        work.mkdir(parents=True, exist_ok=True, mode=0o700)
        if self._note is None:
            self._note = open(work / f"{self._suffix}.lock", "w", encoding="ascii")  # noqa: SIM115
            fcntl.flock(self._note, fcntl.LOCK_EX)
        for path in work.glob("*.lock"):
            with suppress(OSError), open(path, encoding="ascii") as note:
                # Locked as long as its worker lives, in whatever container; process ids repeat.
                fcntl.flock(note, fcntl.LOCK_EX | fcntl.LOCK_NB)
                for folder in work.glob(f"*.{path.stem}"):
                    remove(folder)
                remove(path)
