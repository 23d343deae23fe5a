"""The health of the workers of a machine, as a container's health check asks for it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from specimap_infra.settings import load_settings
from specimap_workers.health import SILENT_LEASES, workers_here
from specimap_workers.presence import Presence
from tests.support.serve_scene import running
from tests.support.worker_scene import until


@contextmanager
def present(folder: Path, executor: str) -> Iterator[Presence]:
    """A worker's note, for the time of the block."""
    presence = Presence(folder, executor)
    presence.announce()
    try:
        yield presence
    finally:
        assert presence._note is not None
        presence._note.close()


def test_workers_of_other_hosts_and_dead_ones_do_not_count(tmp_path: Path) -> None:
    settings = load_settings(data_dir=tmp_path, lease_seconds=10.0)
    work = settings.scratch / "work"
    assert not workers_here(settings, "here").sound
    with present(work, "there:0:aaaa"):
        assert not workers_here(settings, "here").sound
        with present(work, "here:0:bbbb"):
            assert workers_here(settings, "here").lively == ("here:0:bbbb",)
            assert workers_here(settings, "here").sound
        # A note that outlived its worker is not locked.
        assert (work / "bbbb.lock").exists()
        assert not workers_here(settings, "here").sound


def test_a_worker_that_lives_and_does_not_get_on_is_silent_until_it_beats(tmp_path: Path) -> None:
    settings = load_settings(data_dir=tmp_path, lease_seconds=10.0)
    work = settings.scratch / "work"
    with present(work, "here:0:aaaa") as presence:
        past = time.time() - SILENT_LEASES * settings.lease_seconds - 1
        os.utime(work / "aaaa.lock", (past, past))
        assert workers_here(settings, "here").silent == ("here:0:aaaa",)
        assert not workers_here(settings, "here").sound
        presence.beat()
        assert workers_here(settings, "here").sound


@pytest.mark.slow
@pytest.mark.waits
def test_the_command_tells_a_worker_that_runs_from_one_that_is_frozen(tmp_path: Path) -> None:
    settings = {"SPECIMAP_LEASE_SECONDS": "0.4", "SPECIMAP_HEARTBEAT_SECONDS": "0.2"}

    def health() -> int:
        with running(tmp_path, "worker", "--health", **settings) as asked:
            return asked.process.wait(30)

    assert health() == 1
    with running(tmp_path, "worker", **settings) as served:
        work = tmp_path / "scratch" / "work"
        until(lambda: list(work.glob("*.lock")), 60, "the worker's note")
        until(lambda: health() == 0, 30, "a sound worker")
        tasks = Path(f"/proc/{served.process.pid}/task").glob("*/children")
        (child,) = [int(pid) for task in tasks for pid in task.read_text().split()]
        os.kill(child, signal.SIGSTOP)
        until(lambda: health() == 1, 30, "a silent worker")
        os.kill(child, signal.SIGCONT)
        until(lambda: health() == 0, 30, "a worker that gets on")
