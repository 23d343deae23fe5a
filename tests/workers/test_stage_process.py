"""A stage's process seen from the worker: answers, limits, cancelling, and nothing left behind."""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from specimap_core.sandbox.json_lines import InvalidMessageError
from specimap_infra.errors import StageTimeoutError
from specimap_workers.stage_process import SPARES, Processes, RefusedError, StageCrashedError, StageProcess
from specimap_workers.workspaces import Workspaces

SPEC = {"stage": "reconstruct"}
READ = "import json, os, signal, sys, time\nspec = json.loads(sys.stdin.readline())\n"
SOON_SECONDS = 10.0
CGROUPS = Path("/sys/fs/cgroup")


def run(tmp_path: Path, program: str, use: Callable[[StageProcess], Awaitable[None]]) -> None:
    """Start a stage's process with that program, use it, and assert that it is gone with its workspace."""

    async def main() -> None:
        workspaces = Workspaces(tmp_path, "test", "off", ())
        process = await StageProcess.start([sys.executable, "-S", "-c", READ + program], workspaces)
        try:
            await use(process)
        finally:
            await process.end()
        assert not process.alive

    threads = threading.active_count()
    asyncio.run(main())
    assert threading.active_count() == threads
    assert list(tmp_path.iterdir()) == []


async def ignore(stage: str, share: float) -> None:
    del stage, share


def test_progress_and_the_answer(tmp_path: Path) -> None:
    seen: list[tuple[str, float]] = []

    async def progress(stage: str, share: float) -> None:
        seen.append((stage, share))

    async def use(process: StageProcess) -> None:
        assert await process.run(SPEC, progress, 60) == 1.5
        assert not process.alive

    program = (
        "for share in (0, 0.5): print(json.dumps({'event': 'progress', 'stage': spec['stage'], 'share': share}))\n"
        "print(json.dumps({'event': 'done', 'seconds': 1.5}), flush=True); time.sleep(600)"
    )
    run(tmp_path, program, use)
    assert seen == [("reconstruct", 0), ("reconstruct", 0.5)]


def test_a_refusal(tmp_path: Path) -> None:
    async def use(process: StageProcess) -> None:
        with pytest.raises(RefusedError) as caught:
            await process.run(SPEC, ignore, 60)
        assert caught.value.error == {"code": "no_markers_found", "message": "None."}

    error = "{'code': 'no_markers_found', 'message': 'None.'}"
    run(tmp_path, f"print(json.dumps({{'event': 'failed', 'error': {error}}}), flush=True)", use)


@pytest.mark.parametrize(
    ("program", "reason"),
    [
        ("print('why', file=sys.stderr); sys.exit(3)", "ended with status 3"),
        ("print('why', file=sys.stderr); os.kill(os.getpid(), signal.SIGSEGV)", "was ended by SIGSEGV"),
        (
            "print('why', file=sys.stderr); os.kill(os.getpid(), signal.SIGKILL)",
            "was ended by SIGKILL",
        ),
    ],
)
@pytest.mark.usefixtures("no_memory_kills")
def test_a_crash_has_its_reason_and_its_last_lines(tmp_path: Path, program: str, reason: str) -> None:
    async def use(process: StageProcess) -> None:
        with pytest.raises(StageCrashedError) as caught:
            await process.run(SPEC, ignore, 60)
        assert (caught.value.reason, caught.value.tail) == (reason, ["why"])
        assert caught.value.from_outside == ("SIGKILL" in reason)

    run(tmp_path, program, use)


@pytest.fixture
def little_memory(memory_kills: None) -> Iterator[Path]:
    """A control group whose processes may take 64 MB; skips where none can be made."""
    for parent, limit in ((CGROUPS / "memory", "memory.limit_in_bytes"), (CGROUPS, "memory.max")):
        group = parent / f"specimap-test-{os.getpid()}"
        try:
            group.mkdir()
            (group / limit).write_text("67108864")
        except OSError:
            with suppress(OSError):
                group.rmdir()
            continue
        yield group / "cgroup.procs"
        group.rmdir()
        return
    pytest.skip("no control group can be made here: that takes root's rights")


def test_a_process_killed_for_want_of_memory_has_crashed(tmp_path: Path, little_memory: Path) -> None:
    async def use(process: StageProcess) -> None:
        with pytest.raises(StageCrashedError) as caught:
            await process.run(SPEC, ignore, 60)
        assert caught.value.reason == "was ended by SIGKILL (out of memory)"
        assert not caught.value.from_outside

    group = repr(str(little_memory))
    run(tmp_path, f"open({group}, 'w').write(str(os.getpid())); data = b'1' * 200_000_000; time.sleep(60)", use)


def test_the_kernel_takes_a_stage_before_its_worker(tmp_path: Path) -> None:
    async def use(process: StageProcess) -> None:
        assert await process.run(SPEC, ignore, 60) == 1000

    score = "int(open('/proc/self/oom_score_adj').read())"
    run(tmp_path, f"print(json.dumps({{'event': 'done', 'seconds': {score}}}), flush=True); time.sleep(60)", use)


def test_a_line_that_is_no_message_ends_the_stage(tmp_path: Path) -> None:
    async def use(process: StageProcess) -> None:
        with pytest.raises(InvalidMessageError):
            await process.run(SPEC, ignore, 60)
        assert not process.alive

    run(tmp_path, "print('noise', flush=True); time.sleep(600)", use)


@pytest.mark.parametrize("program", ["time.sleep(600)", "while True: os.write(2, b'x' * 65536)"])
def test_a_stage_that_takes_too_long(tmp_path: Path, program: str) -> None:
    async def use(process: StageProcess) -> None:
        begin = time.monotonic()
        with pytest.raises(StageTimeoutError, match="reconstruct"):
            await process.run(SPEC, ignore, 0.5)
        assert 0.5 <= time.monotonic() - begin < SOON_SECONDS

    run(tmp_path, program, use)


def test_cancelling_takes_effect_at_once(tmp_path: Path) -> None:
    async def use(process: StageProcess) -> None:
        running = asyncio.create_task(process.run(SPEC, ignore, 60))
        await asyncio.sleep(0.5)
        assert process.alive
        begin = time.monotonic()
        running.cancel()
        with pytest.raises(asyncio.CancelledError):
            await running
        assert time.monotonic() - begin < SOON_SECONDS
        assert not process.alive

    run(tmp_path, "time.sleep(600)", use)


def test_processes_are_kept_in_reserve_and_a_dead_one_is_replaced(tmp_path: Path) -> None:
    async def main() -> None:
        program = (sys.executable, "-S", "-c", READ + "time.sleep(600)")
        processes = Processes(Workspaces(tmp_path, "test", "off", ()), program)
        processes.prepare()
        first = await processes.take()
        assert len(processes._spares) == SPARES - 1
        await processes._spares[0].kill()
        processes.prepare()
        second = await processes.take()
        assert first.alive
        assert second.alive
        for process in (first, second):
            await process.end()
        await processes.close()

    asyncio.run(main())
    assert list(tmp_path.iterdir()) == []
