"""A worker: one process for one slot. It takes jobs from the queue, and takes over what dead workers left."""

from __future__ import annotations

import asyncio
import signal
import threading
import time
from collections.abc import Sequence
from typing import Any, Self

import httpx
from dbos import DBOS, DBOSConfig

from specimap_core.errors import SpecimapError
from specimap_core.reconstruct.backends.environment import BackendSettings
from specimap_infra.database import Database, database_errors, make_engine
from specimap_infra.errors import DatabaseUnavailableError, LostLeaseError
from specimap_infra.housekeeping import Housekeeping
from specimap_infra.logs import logger
from specimap_infra.migrate import migrate
from specimap_infra.notifications import DELIVERIES, QUEUED, Listener
from specimap_infra.queue import (
    APPLICATION,
    APPLICATION_VERSION,
    EXPORTS,
    JOBS,
    MAKE_EXPORT,
    POLL_SECONDS,
    QUIET_SECONDS,
    RUN_JOB,
    JsonSerializer,
    poll_seconds,
    queue_client,
)
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.webhooks import deliver_due, seconds_to_next, webhook_client
from specimap_workers.executors import suffix_of
from specimap_workers.exports import run_export
from specimap_workers.job import STAGES, JobRun
from specimap_workers.leases import LeaseKeeper
from specimap_workers.presence import Presence
from specimap_workers.queue_threads import QueueThreads, quieten_engine
from specimap_workers.reaper import Reaper
from specimap_workers.stage_process import COMMAND, Processes
from specimap_workers.workspaces import Workspaces

DELIVERY_SECONDS = 1.0
SWEEP_SECONDS = 15.0
STOP_SECONDS = 0.25
POOL = {"pool_size": 2, "overflow": 6}
"""Of the worker's own connections, and of the engine's; docs/hospital-it.md adds them up."""


class Worker:
    """Everything one worker process holds."""

    def __init__(
        self,
        settings: ServiceSettings,
        backends: BackendSettings,
        executor: str,
        *,
        kind: str = "cpu",
        command: Sequence[str] = COMMAND,
    ) -> None:
        self.settings = settings
        self._backends = backends
        self.executor = executor
        self._database = Database.open(settings.database, **POOL)
        self._storage = Storage.open(settings)
        self._listener = Listener(self._database, (QUEUED, DELIVERIES), self._told)
        self._threads: QueueThreads | None = None
        self._to_deliver = threading.Event()
        work = settings.scratch / "work"
        self._presence = Presence(work, self.executor)
        self._reaper = Reaper(self._database, queue_client(self._database.engine))
        self._buried: set[str] = set()
        workspaces = Workspaces.of(settings, work, suffix_of(self.executor), backends)
        self._processes = Processes(workspaces, command, memory_bytes=settings.stage_memory_bytes)
        self._kind = kind
        self._stopping = threading.Event()

    @classmethod
    def ready(
        cls,
        settings: ServiceSettings,
        backends: BackendSettings,
        executor: str,
        *,
        kind: str = "cpu",
        command: Sequence[str] = COMMAND,
    ) -> Self:
        """Make one once the database, which is brought to this version's schema, and the storage can be used.

        Raises:
            DatabaseUnavailableError, StorageUnavailableError, OutputNotWritableError: they cannot; try again.
        """
        database = Database.open(settings.database)
        try:
            migrate(database)
            Storage.open(settings).check_at_start()
        finally:
            database.close()
        return cls(settings, backends, executor, kind=kind, command=command)

    def run(self) -> None:
        """Work until SIGTERM or SIGINT.

        Raises:
            DatabaseUnavailableError: it went away before the work began.
        """
        self._presence.announce()
        self._look_after(None)
        self._sweep()
        self._register()
        engine = self._configure()
        keeper = LeaseKeeper(
            self._database,
            self.executor,
            kind=self._kind,
            heartbeat_seconds=self.settings.heartbeat_seconds,
            lease_seconds=self.settings.lease_seconds,
            look_after=self._look_after,
            settle=self._reaper.settle,
            beat=self._presence.beat,
        )
        keeper.start()
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: self._stopping.set())
        DBOS.listen_queues([JOBS, EXPORTS])
        quieten_engine()
        with database_errors():
            DBOS.launch()
            polling = poll_seconds(self._database.engine)
            queues = [
                DBOS.register_queue(
                    queue, worker_concurrency=1, polling_interval_sec=polling, on_conflict="always_update"
                )
                for queue in (JOBS, EXPORTS)
            ]
        self._threads = QueueThreads(engine, queues, lambda: self._listener.listening)
        self._listener.start()
        logger().info("worker started", executor=self.executor)
        housekeeping = Housekeeping(self._database, self._storage, self.settings, queue_client(self._database.engine))
        housekeeping.start()
        try:
            self._deliver_until_stopped()
        finally:
            # What runs is not waited for: its job goes on elsewhere from the last finished stage.
            DBOS.destroy(workflow_completion_timeout_sec=0)
            try:
                self._reaper.hand_over(self.executor, died=False)
            except DatabaseUnavailableError:
                logger().warning("jobs not handed over yet: the database is away", executor=self.executor)
            keeper.stop()
            housekeeping.stop()
            self._listener.stop()
            logger().info("worker stopped", executor=self.executor)

    def _told(self, channel: str, payload: str) -> None:
        """Look for what a notification tells of."""
        if channel == QUEUED:
            self._look_for_more(payload)
        if channel == DELIVERIES:
            self._to_deliver.set()

    def _deliver_until_stopped(self) -> None:
        with webhook_client() as client:
            swept = looked = time.monotonic()
            wait = DELIVERY_SECONDS
            while not self._stopping.is_set():
                # Not a wait for the end: its signal may come within the wait, and would wait for the wait's lock.
                told = self._to_deliver.wait(STOP_SECONDS)
                now = time.monotonic()
                if now - swept > SWEEP_SECONDS:
                    swept = now
                    self._sweep()
                if told or now - looked >= wait:
                    looked = now
                    self._to_deliver.clear()
                    wait = self._deliver(client)

    def _deliver(self, client: httpx.Client) -> float:
        """Deliver what is due; return how many seconds to wait before the next look."""
        try:
            deliver_due(self._database, self.settings, client)
            if self._listener.listening:
                return max(DELIVERY_SECONDS, seconds_to_next(self._database, QUIET_SECONDS))
        except DatabaseUnavailableError:
            pass  # they are delivered once it is back; the log tells that it is away
        except SpecimapError as error:
            logger().warning("webhooks not delivered", code=error.code)
        return DELIVERY_SECONDS

    def _configure(self) -> DBOS:
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
        if self._database.engine.dialect.name != "sqlite":
            # Of its own, since it holds connections for long; with limits to its waits, which the engine's have not.
            config["system_database_engine"] = make_engine(self.settings.database, **POOL)
        return DBOS(config=config)

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
                self._look_for_more(JOBS)

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
                self._look_for_more(EXPORTS)
            return "done"

        self._workflows = run_job, make_export, stage_step

    def _look_for_more(self, queue: str) -> None:
        if self._threads is not None:
            self._threads.wake(queue)

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

    def _look_after(self, living: set[str] | None) -> None:
        """Hand over the work of the dead: of this machine's at once, of others' once their leases have run out."""
        for executor in set(self._presence.dead()) - self._buried:
            self._reaper.bury(executor)
            self._buried.add(executor)
        if living is not None:
            self._reaper.look_after(living)

    def _sweep(self) -> None:
        """Remove work folders of this machine's dead whose work has been handed over."""
        for executor in set(self._presence.dead()) & self._buried:
            self._presence.forget(executor)
