"""The health of the processes of a machine, as a container's health check asks for it."""

from __future__ import annotations

import os
import signal
import time
from contextlib import closing
from pathlib import Path

import pytest

from specimap_infra.heartbeats import Note, health_of
from tests.support.serve_scene import running
from tests.support.worker_scene import until


def test_processes_of_other_hosts_and_dead_ones_do_not_count(tmp_path: Path) -> None:
    assert not health_of(tmp_path / "nowhere", 90, "here").sound
    with closing(Note.leave(tmp_path, "a", "there:0:a")):
        assert not health_of(tmp_path, 90, "here").sound
        with closing(Note.leave(tmp_path, "b", "here:0:b")):
            assert health_of(tmp_path, 90, "here").lively == ("here:0:b",)
            assert health_of(tmp_path, 90, "here").sound
        # A note that outlived its process is not locked.
        assert (tmp_path / "b.lock").exists()
        assert not health_of(tmp_path, 90, "here").sound


def test_a_process_that_lives_and_does_not_get_on_is_silent_until_it_beats(tmp_path: Path) -> None:
    with closing(Note.leave(tmp_path, "a", "here:0:a")) as note:
        past = time.time() - 91
        os.utime(tmp_path / "a.lock", (past, past))
        assert health_of(tmp_path, 90, "here").silent == ("here:0:a",)
        assert not health_of(tmp_path, 90, "here").sound
        note.beat()
        assert health_of(tmp_path, 90, "here").sound


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
