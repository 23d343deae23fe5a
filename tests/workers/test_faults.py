"""Workers and stages that are killed, frozen or poisoned; jobs that are cancelled."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from specimap_core.cloud import Cloud
from specimap_core.pipeline.clock import STAGES
from specimap_infra.setbacks import Setbacks
from specimap_workers.executors import suffix_of
from specimap_workers.stage_process import SPARES
from tests.support.scenes import Finished, OnDisk
from tests.support.worker_scene import QUICK, STAGE_SCRIPT, Shop, processes_of, shop, until

pytestmark = [pytest.mark.slow, pytest.mark.waits]

TAKEOVER_SECONDS = 20.0


@pytest.fixture
def yard(tmp_path: Path) -> Iterator[Shop]:
    with shop(tmp_path / "shop") as opened:
        yield opened


def assert_same_cloud(yard: Shop, job_id: str, finished: Finished) -> None:
    """The job's result equals that of a run that nothing disturbed: meshes differ in their last digits only."""
    row = yard.cloud(job_id)
    assert yard.storage.folder is not None
    mine = Cloud.open(yard.storage.folder / row.prefix / "cloud.zarr")
    theirs = Cloud.open(finished.out / "cloud.zarr")
    assert abs(mine.n_points - theirs.n_points) < 0.01 * theirs.n_points
    both = {tuple(p): k for k, p in enumerate(theirs.hsi_pixel.tolist())}
    pairs = [(k, both[tuple(p)]) for k, p in enumerate(mine.hsi_pixel.tolist()) if tuple(p) in both]
    at, other = np.array(pairs).T
    apart = np.linalg.norm(mine.xyz[at] - theirs.xyz[other], axis=1)
    assert float(np.median(apart)) < 0.01
    np.testing.assert_array_equal(mine.spectra(at[:500]), theirs.spectra(other[:500]))


def gone(pid: int) -> bool:
    return not Path(f"/proc/{pid}").exists()


def taken_from(yard: Shop, job_id: str, executor: str | None) -> bool:
    return yard.job(job_id).executor not in (executor, None)


def tidy(yard: Shop, job_id: str) -> bool:
    return not list((yard.settings.scratch / "work").glob(f"{job_id}*"))


def test_another_worker_goes_on_from_the_last_finished_stage(yard: Shop, small: OnDisk, finished: Finished) -> None:
    acquisition = yard.acquisition(small.photos, small.header)
    holds = {stage: yard.holding(stage) for stage in STAGES}
    first = yard.start()
    job_id = yard.submit(acquisition)
    for stage in STAGES:
        pid = yard.held(stage)
        second = yard.start()
        executor = yard.job(job_id).executor
        killed = time.monotonic()
        first.kill()
        until(partial(gone, pid), 5, "the end of the stage's process")
        until(partial(taken_from, yard, job_id, executor), TAKEOVER_SECONDS, "the takeover")
        assert yard.held(stage) != pid
        assert time.monotonic() - killed < TAKEOVER_SECONDS
        holds[stage].unlink()
        first = second
    job = yard.ended(job_id)
    assert (job.state, job.error) == ("succeeded", None)
    assert yard.ran(job_id) == list(STAGES)
    assert_same_cloud(yard, job_id, finished)


def test_a_killed_stage_is_run_again(yard: Shop, small: OnDisk, finished: Finished) -> None:
    acquisition = yard.acquisition(small.photos, small.header)
    holds = {stage: yard.holding(stage) for stage in STAGES}
    yard.start(QUICK, RESULT_FOLDER=str(finished.out))
    job_id = yard.submit(acquisition)
    for stage in STAGES:
        pid = yard.held(stage)
        os.kill(pid, signal.SIGKILL)
        until(partial(gone, pid), 5, "the end of the stage's process")
        assert yard.held(stage, TAKEOVER_SECONDS) != pid
        holds[stage].unlink()
    assert yard.ended(job_id).state == "succeeded"
    assert yard.ran(job_id) == list(STAGES)
    errors = [e["message"] for e in yard.events(job_id, "log") if e["level"] == "error"]
    assert len(errors) == len(STAGES)
    assert all("SIGKILL" in message for message in errors)
    assert_same_cloud(yard, job_id, finished)


def test_a_frozen_worker_that_wakes_up_changes_nothing(yard: Shop, small: OnDisk, finished: Finished) -> None:
    acquisition = yard.acquisition(small.photos, small.header)
    hold = yard.holding("adjust")
    frozen = yard.start()
    job_id = yard.submit(acquisition)
    pid = yard.held("adjust")
    yard.freeze(frozen)
    awake = yard.start()
    executor = yard.job(job_id).executor
    until(partial(taken_from, yard, job_id, executor), TAKEOVER_SECONDS, "the takeover")
    hold.unlink()
    # The frozen worker's stage finishes too, before its worker wakes up to hear of it.
    until(lambda: yard.ended(job_id).state == "succeeded", 60, "the end")
    cloud, events = yard.cloud(job_id), len(yard.events(job_id, "state"))
    frozen.send_signal(signal.SIGCONT)
    until(partial(gone, pid), 20, "the end of the late stage")
    until(lambda: executor in yard.leases(), 20, "the frozen worker's heartbeat")
    later = yard.submit(acquisition, r_pc=0.7)
    awake.kill()
    assert yard.ended(later).state == "succeeded", "the woken worker works on"
    assert yard.cloud(job_id).id == cloud.id
    assert len(yard.events(job_id, "state")) == events
    assert_same_cloud(yard, job_id, finished)


@pytest.mark.usefixtures("no_memory_kills")
def test_a_job_that_is_killed_more_often_than_it_may_crash_goes_on(
    yard: Shop, small: OnDisk, finished: Finished
) -> None:
    acquisition = yard.acquisition(small.photos, small.header)
    hold = yard.holding("reconstruct")
    start = partial(yard.start, QUICK, RESULT_FOLDER=str(finished.out))
    worker = start()
    job_id = yard.submit(acquisition)
    for number in range(yard.settings.starts + 1):
        pid = yard.held("reconstruct")
        if number % 2:
            os.kill(pid, signal.SIGKILL)
        else:
            worker.kill()
            worker = start()
        until(partial(gone, pid), 5, "the end of the stage's process")
    yard.held("reconstruct")
    setbacks = Setbacks.of(yard.job(job_id).setbacks)
    assert (len(setbacks.interruptions), len(setbacks.crashes)) == (yard.settings.starts + 1, 0)
    hold.unlink()
    job = yard.ended(job_id, 240)
    assert (job.state, job.error) == ("succeeded", None)
    assert job.setbacks == {}


def test_a_dead_worker_of_this_machine_is_found_before_its_lease_has_run_out(tmp_path: Path, small: OnDisk) -> None:
    with shop(tmp_path / "shop", lease_seconds=600) as yard:
        yard.holding("reconstruct")
        first = yard.start()
        job_id = yard.submit(yard.acquisition(small.photos, small.header))
        pid, executor = yard.held("reconstruct"), yard.job(job_id).executor
        yard.start()
        first.kill()
        until(partial(gone, pid), 5, "the end of the stage's process")
        until(partial(taken_from, yard, job_id, executor), TAKEOVER_SECONDS, "the takeover")
        yard.held("reconstruct")
        assert executor not in yard.leases()
        assert executor is not None
        until(lambda: not list((yard.settings.scratch / "work").glob(f"*{suffix_of(executor)}*")), 30, "a sweep")


def test_a_frozen_worker_takes_its_interruption_back(yard: Shop, small: OnDisk) -> None:
    yard.holding("reconstruct")
    frozen = yard.start()
    job_id = yard.submit(yard.acquisition(small.photos, small.header))
    yard.held("reconstruct")
    yard.freeze(frozen)
    yard.start()
    executor = yard.job(job_id).executor
    until(partial(taken_from, yard, job_id, executor), TAKEOVER_SECONDS, "the takeover")
    assert yard.job(job_id).setbacks["interruptions"] == [executor]
    frozen.send_signal(signal.SIGCONT)
    until(lambda: yard.job(job_id).setbacks["interruptions"] == [], 20, "the heartbeat")


@pytest.mark.parametrize("victim", ["KILL_WORKER", "KILL_SELF"])
def test_a_poisoned_job_fails_with_its_reason_and_the_queue_goes_on(
    tmp_path: Path, small: OnDisk, finished: Finished, victim: str
) -> None:
    with shop(tmp_path / "shop", interruptions=3, starts=3) as yard:
        start = partial(yard.start, QUICK, RESULT_FOLDER=str(finished.out))
        acquisition = yard.acquisition(small.photos, small.header)
        poisoned = yard.submit(acquisition)
        for _ in range(yard.settings.interruptions if victim == "KILL_WORKER" else 1):
            worker = start(**{victim: "reconstruct"})
            if victim == "KILL_WORKER":
                worker.wait(30)
        healthy = yard.submit(acquisition)
        if victim == "KILL_WORKER":
            start()
        job = yard.ended(poisoned)
        assert job.state == "failed"
        assert job.error is not None
        assert (job.error["code"], job.error["details"]["stage"]) == ("worker_crashed", "reconstruct")
        assert job.error["details"]["starts"] == 3
        assert job.error["details"]["cause"] == ("interruptions" if victim == "KILL_WORKER" else "crashes")
        if victim == "KILL_SELF":
            assert "SIGSEGV" in job.error["message"]
            yard.stop()
            start()
            healthy = yard.submit(acquisition)
        assert yard.ended(healthy).state == "succeeded"


def test_a_cancelled_job_stops_in_every_stage_and_leaves_nothing(yard: Shop, small: OnDisk, finished: Finished) -> None:
    acquisition = yard.acquisition(small.photos, small.header)
    worker = yard.start(QUICK, RESULT_FOLDER=str(finished.out))
    for stage in STAGES:
        hold = yard.holding(stage)
        job_id = yard.submit(acquisition)
        pid = yard.held(stage)
        cancelled = time.monotonic()
        yard.cancel(job_id)
        until(partial(gone, pid), 5, f"the end of {stage}'s process")
        until(partial(tidy, yard, job_id), 5, "the work folder's removal")
        assert time.monotonic() - cancelled < 5
        hold.unlink()
        assert yard.job(job_id).state == "cancelled"
        assert not list(yard.storage.list(f"jobs/{job_id}"))
    done = yard.submit(acquisition)
    assert yard.ended(done).state == "succeeded"
    # Those that wait for the next stages; no other is left.
    assert len(processes_of([STAGE_SCRIPT, f"\0{worker.pid}\0"])) <= SPARES


LEAVES_A_LINK = """
import json, os, sys
spec = json.loads(sys.stdin.readline() or "null")
if spec:
    stages = os.path.join(spec["out"], "stages")
    os.makedirs(stages, exist_ok=True)
    artefact = os.path.join(stages, f"{spec['stage']}-{spec['keys'][spec['stage']]}.npz")
    if not os.path.lexists(artefact):
        os.symlink(os.environ["HOLD_FOLDER"] + "/secret", artefact)
    print(json.dumps({"event": "done", "seconds": 0.01}), flush=True)
"""


def test_a_stage_that_leaves_a_link_has_failed(yard: Shop, small: OnDisk, tmp_path: Path) -> None:
    (yard.hold / "secret").write_text("what the service's user alone may read")
    script = tmp_path / "leaves.py"
    script.write_text(LEAVES_A_LINK)
    acquisition = yard.acquisition(small.photos, small.header)
    yard.start(f"{sys.executable} {script}")
    job = yard.ended(yard.submit(acquisition))
    assert job.error is not None
    assert (job.state, job.error["code"]) == ("failed", "worker_crashed")
    assert "left something that is no file" in job.error["message"]
    assert not list(yard.storage.list(f"acquisitions/{acquisition}/stages"))
