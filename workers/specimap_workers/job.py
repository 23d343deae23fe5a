"""One job: its stages in order, each in a process of its own, each result stored before the next begins."""

from __future__ import annotations

import asyncio
import os
import time
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import SpecimapError
from specimap_core.pipeline.clock import STAGES
from specimap_core.pipeline.outputs import prepare_folder
from specimap_core.reconstruct.backends.environment import BackendSettings
from specimap_core.report.model import Report
from specimap_infra import jobs
from specimap_infra.database import Database
from specimap_infra.errors import DatabaseUnavailableError, LostLeaseError, WorkerCrashedError
from specimap_infra.ids import new_id
from specimap_infra.logs import logger
from specimap_infra.setbacks import Setbacks, pause_seconds
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage, link
from specimap_infra.tables import CloudRow, Job
from specimap_workers.artefacts import SAVED, Artefacts
from specimap_workers.executors import suffix_of
from specimap_workers.patience import patience
from specimap_workers.plan import Plan, plan_of
from specimap_workers.stage_process import Processes, RefusedError, StageCrashedError, StageProcess
from specimap_workers.workspaces import is_plain

Value = TypeVar("Value")
PROGRESS_SECONDS = 0.4
"""Least time between two progress events of a stage: a person sees no more, and each is a transaction."""
HELD_SECONDS = 3.0
"""Longest pause between two processes of a stage: the slot waits meanwhile, and others may be in the queue."""
RESULTS = ("cloud.zarr", "mesh.ply", "corners.json", "cameras.json", "preview.png", "report.json")
SHEET = "photos.jpg"
"""Not there where stage 1 was kept from a version that made none."""


class JobRun:
    """A job that one executor runs."""

    def __init__(
        self,
        job_id: str,
        executor: str,
        *,
        database: Database,
        storage: Storage,
        settings: ServiceSettings,
        processes: Processes,
        backends: BackendSettings,
    ) -> None:
        self.job_id = job_id
        self.executor = executor
        self._database = database
        self._storage = storage
        self._settings = settings
        self._processes = processes
        self._backends = backends
        self.folder = work_folder(settings.scratch, job_id, executor)
        self._inputs, self._out = self.folder / "inputs", self.folder / "out"
        self._plan: Plan | None = None
        self._patiently = patience(settings.patience_seconds)

    # ---- called by the workflow -----------------------------------------------------------------------

    async def claim(self) -> bool:
        """Take the job; false where it is gone or has ended."""

        def take() -> bool:
            with self._database.session() as session:
                job = jobs.claim(session, self.job_id, self.executor)
                if job is None:
                    return False
                error = self._hopeless(job.stage or "reconstruct", Setbacks.of(job.setbacks))
                if error is not None:
                    jobs.finish(session, self.job_id, self.executor, "failed", error)
                return error is None

        return await self._thread(take)

    async def stage(self, stage: str) -> dict[str, Any]:
        """Run a stage, or find what an earlier run left: ``seconds`` and ``reused``, or ``error``."""
        try:
            plan = await self._planned()
            if stage in SAVED:
                found = await self._thread(self._artefacts(plan).seconds, stage, plan.keys[stage])
                if found is not None:
                    await self._log("info", f"Stage {stage} is there from an earlier run.", stage=stage)
                    return {"stage": stage, "seconds": found, "reused": True}
                return {"stage": stage, "seconds": await self._make(plan, stage), "reused": False}
            return await self._register(plan)
        except LostLeaseError:
            raise
        except RefusedError as refused:
            return {"stage": stage, "error": refused.error}
        except SpecimapError as error:
            if isinstance(error, DatabaseUnavailableError):
                raise
            return {"stage": stage, "error": error.as_dict()}
        except Exception as error:
            logger().exception("unforeseen error", job=self.job_id, stage=stage)
            unknown = SpecimapError(
                f"An error that Specimap does not know, in stage {stage}: {type(error).__name__}.",
                advice="Report it with the worker's log; finished stages are kept.",
            )
            return {"stage": stage, "error": unknown.as_dict()}

    async def finish(self, outcomes: list[dict[str, Any]]) -> str:
        """Write the end of the job: its cloud, or why it failed. Gives the state."""
        error = next((o["error"] for o in outcomes if "error" in o), None)
        seconds = {o["stage"]: float(o["seconds"]) for o in outcomes if "seconds" in o}
        report = None
        if error is None:
            try:
                text = await self._thread(self._storage.read, f"{outcomes[-1]['prefix']}/report.json")
                report = Report.model_validate_json(text)
            except SpecimapError as away:
                error = away.as_dict()

        def end() -> str:
            with self._database.session() as session:
                job = jobs.locked(session, self.job_id)
                if job is None or job.state != "running":
                    return job.state if job else "deleted"
                if report is not None:
                    session.add(self._cloud(job, outcomes[-1], report))
                    session.flush()
                state: jobs.FinalState = "failed" if error else "succeeded"
                jobs.finish(session, self.job_id, self.executor, state, error, seconds)
                return state

        return await self._thread(end)

    def clear(self) -> None:
        """Remove the work folder."""
        remove(self.folder)

    def _cloud(self, job: Job, outcome: dict[str, Any], report: Report) -> CloudRow:
        return CloudRow(
            id=new_id("cloud"),
            job_id=job.id,
            acquisition_id=job.acquisition_id,
            project_id=job.project_id,
            prefix=outcome["prefix"],
            points=report.coverage.points,
            bands=outcome["bands"],
            size=outcome["size"],
            report=report.model_dump(mode="json"),
        )

    # ---- stages ---------------------------------------------------------------------------------------

    async def _make(self, plan: Plan, stage: str) -> float:
        """Run a stage that leaves an artefact, whatever it needs first."""
        await self._needs(plan, stage)
        seconds = await self._run(plan, stage)
        await self._thread(
            self._artefacts(plan).keep, stage, plan.keys[stage], self._out, seconds, self.job_id, self.executor
        )
        return seconds

    async def _register(self, plan: Plan) -> dict[str, Any]:
        await self._needs(plan, "register")
        seconds = await self._run(plan, "register")
        prefix = f"jobs/{self.job_id}/register/{new_id('att')}"
        size, bands = await self._thread(self._publish, prefix)
        return {
            "stage": "register",
            "seconds": seconds,
            "reused": False,
            "prefix": prefix,
            "size": size,
            "bands": bands,
        }

    async def _needs(self, plan: Plan, stage: str) -> None:
        """Bring the inputs and the artefacts of the stages before; one that was lost is made again."""
        await self._thread(prepare_folder, self._out)
        await self._thread(plan.fetch, self._storage, self._inputs)
        before = {"reconstruct": (), "adjust": ("reconstruct",), "render": ("adjust",)}
        for name in before.get(stage, SAVED):
            if not await self._thread(self._artefacts(plan).fetch, name, plan.keys[name], self._out):
                await self._make(plan, name)

    def _publish(self, prefix: str) -> tuple[int, int]:
        with self._storage.publishing(prefix) as aside, disk_errors(aside):
            for name in (*RESULTS, *([SHEET] if (self._out / SHEET).exists() else [])):
                # Linked, not moved: where the storage is away, this is done again.
                link(self._out / name, aside / name)
            size = sum(p.stat().st_size for p in aside.rglob("*") if p.is_file())
            # Read here, where the cloud is on the local disk: the report does not hold it.
            from specimap_core.cloud import Cloud

            bands = Cloud.open(aside / "cloud.zarr").bands
        return size, bands

    async def _run(self, plan: Plan, stage: str) -> float:
        """One stage in a process, again where the process died."""
        earlier = await self._thread(self._earlier, plan)
        spec = {
            "stage": stage,
            "settings": plan.settings,
            "keys": plan.keys,
            "hashes": plan.hashes,
            "workers": os.cpu_count() or 1,
            "seconds": {name: seconds for name, seconds, _ in earlier},
            "reused": [name for name, _, reused in earlier if reused],
        }
        while True:
            process = await self._processes.take()
            self._processes.prepare()
            try:
                with process.workspace.holding(self._inputs, self._out) as (inputs, out):
                    places = {"inputs": plan.inputs(inputs), "out": str(out)}
                    seconds = await self._watch(process, spec | places, stage)
                if not await self._thread(is_plain, self._out):
                    raise StageCrashedError("left something that is no file", [])
                return seconds
            except StageCrashedError as crash:
                logger().error(
                    "stage's process ended", job=self.job_id, stage=stage, reason=crash.reason, last_lines=crash.tail
                )
                setbacks = await self._thread(self._set_back, uuid.uuid4().hex[:12], crash)
                counts = {"crashes": len(setbacks.crashes), "interruptions": len(setbacks.interruptions)}
                await self._log("error", f"The process of stage {stage} {crash.reason}.", stage=stage, **counts)
                error = self._hopeless(stage, setbacks, crash.reason)
                if error is not None:
                    raise error from crash
                pause = min(pause_seconds(len(setbacks.interruptions)) if crash.from_outside else 0.0, HELD_SECONDS)
            finally:
                await process.end()
            await asyncio.sleep(pause)

    async def _watch(self, process: StageProcess, spec: dict[str, Any], stage: str) -> float:
        last = 0.0

        async def progress(name: str, share: float) -> None:
            nonlocal last
            now = time.monotonic()
            if name != stage or (now - last < PROGRESS_SECONDS and share < 1.0):
                return
            last = now
            try:
                await asyncio.to_thread(self._report_progress, stage, share)
            except DatabaseUnavailableError:
                logger().debug("progress not written: the database is away", job=self.job_id, stage=stage)

        return await process.run(spec, progress, self._settings.stage_seconds)

    def _report_progress(self, stage: str, share: float) -> None:
        with self._database.session() as session:
            jobs.report_progress(session, self.job_id, self.executor, stage, share)  # type: ignore[arg-type]

    def _set_back(self, name: str, crash: StageCrashedError) -> Setbacks:
        with self._database.session() as session:
            return jobs.set_back(session, self.job_id, self.executor, name, crash=not crash.from_outside)

    def _hopeless(self, stage: str, setbacks: Setbacks, reason: str = "died") -> WorkerCrashedError | None:
        limits = {"crashes": self._settings.starts, "interruptions": self._settings.interruptions}
        return setbacks.failure(stage, reason, **limits)

    def _earlier(self, plan: Plan) -> list[tuple[str, float, bool]]:
        """Stages before that are done, with their seconds and whether this job found them done."""
        with self._database.session() as session:
            mine = session.get_one(Job, self.job_id).seconds
        artefacts = self._artefacts(plan)
        done = ((name, artefacts.seconds(name, plan.keys[name]), name not in mine) for name in SAVED)
        return [(name, seconds, reused) for name, seconds, reused in done if seconds is not None]

    # ---- helpers --------------------------------------------------------------------------------------

    async def _planned(self) -> Plan:
        if self._plan is None:
            self._plan = await self._thread(plan_of, self._database, self.job_id, self._backends)
        return self._plan

    def _artefacts(self, plan: Plan) -> Artefacts:
        return Artefacts(self._database, self._storage, plan.acquisition_id)

    async def _log(self, level: jobs.Level, message: str, **data: object) -> None:
        def write() -> None:
            with self._database.session() as session:
                jobs.log(session, self.job_id, self.executor, level, message, **data)

        await self._thread(write)

    async def _thread(self, call: Callable[..., Value], *args: object) -> Value:
        """Call in a thread, and again where the database or the storage is away."""
        return await asyncio.to_thread(self._patiently, call, *args)


def work_folder(scratch: Path, job_id: str, executor: str) -> Path:
    """Where an executor works on a job; no other one works there."""
    return scratch / "work" / f"{job_id}.{suffix_of(executor)}"


__all__ = ["STAGES", "JobRun", "work_folder"]
