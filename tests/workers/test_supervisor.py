"""Supervisors: what a dead worker held goes on at once, and no end of a worker is final."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from specimap_workers.reaper import burier
from specimap_workers.supervisor import Supervisor
from tests.support.scenes import OnDisk
from tests.support.worker_scene import HELD, Shop, processes_of, shop, until

pytestmark = pytest.mark.slow


@contextmanager
def supervised(yard: Shop, slots: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Have a supervisor of this process run workers in a shop."""
    for name, value in {**yard.environment, "HOLD_FOLDER": str(yard.hold)}.items():
        monkeypatch.setenv(name, value)
    supervisor = Supervisor(slots, ("--stage-command", HELD), burier(yard.settings))
    supervisor.start()
    try:
        yield
    finally:
        supervisor.stop()


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def test_what_a_dead_worker_held_goes_on_without_waiting_for_a_heartbeat(
    tmp_path: Path, small: OnDisk, monkeypatch: pytest.MonkeyPatch
) -> None:
    with (
        shop(tmp_path / "shop", heartbeat_seconds=300, lease_seconds=600) as yard,
        supervised(yard, 2, monkeypatch),
    ):
        until(lambda: len(yard.leases()) == 2, 60, "two workers")
        yard.holding("reconstruct")
        job_id = yard.submit(yard.acquisition(small.photos, small.header))
        pid, executor = yard.held("reconstruct"), yard.job(job_id).executor
        os.kill(parent(pid), signal.SIGKILL)
        until(lambda: yard.job(job_id).executor not in (executor, None), 60, "the takeover")
        assert executor not in yard.leases()
        assert yard.job(job_id).setbacks["interruptions"] == [executor]
        until(lambda: len(yard.leases()) == 2, 60, "a worker in its place")


def test_a_worker_that_a_setting_keeps_from_its_work_is_started_until_it_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with shop(tmp_path / "shop") as yard:
        monkeypatch.setenv("SPECIMAP_SLOTS", "none")
        with supervised(yard, 1, monkeypatch):
            refused: list[str] = []

            def twice() -> bool:
                refused.extend(capfd.readouterr())
                return "".join(refused).count("SPECIMAP_SLOTS") >= 2

            until(twice, 60, "two refusals")
            assert not yard.leases()
            monkeypatch.delenv("SPECIMAP_SLOTS")
            until(yard.leases, 60, "a worker")
        assert not processes_of(["specimap_workers", "--parent", str(os.getpid())])
        assert not yard.leases()
