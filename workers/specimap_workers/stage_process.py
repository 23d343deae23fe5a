"""Processes for stages: one is always kept ready, so that a stage does not wait for imports."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from specimap_core.errors import SpecimapError
from specimap_core.json_text import json_text
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES
from specimap_infra.errors import StageTimeoutError
from specimap_workers.workspaces import Workspace, Workspaces

COMMAND = (sys.executable, "-m", "specimap_workers.stage_main")
LAST_LINES = 40
SPARES = 2
"""One for the next stage and one for that after it: rendering takes a tenth of a second, less than an import."""
LINE_LIMIT = 1 << 20


class StageCrashedError(Exception):
    """A stage's process ended without an answer; ``reason`` in words, ``tail`` its last lines."""

    def __init__(self, reason: str, tail: Sequence[str]) -> None:
        super().__init__(reason)
        self.reason = reason
        self.tail = list(tail)


class RefusedError(Exception):
    """A stage refused its input; ``error`` as ``SpecimapError.as_dict`` gives it."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(str(error.get("message")))
        self.error = error


class StageProcess:
    """One process, for one stage."""

    def __init__(self, process: asyncio.subprocess.Process, workspace: Workspace) -> None:
        self._process = process
        self.workspace = workspace
        self._tail: deque[str] = deque(maxlen=LAST_LINES)
        self._reading = asyncio.create_task(self._read_errors())

    @classmethod
    async def start(cls, command: Sequence[str], workspaces: Workspaces) -> StageProcess:
        """Start it in a workspace of its own; it loads its libraries meanwhile."""
        workspace = await asyncio.to_thread(workspaces.new)
        process = await asyncio.create_subprocess_exec(
            *await asyncio.to_thread(partial(workspaces.confined, command, workspace, backends=True)),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
            limit=LINE_LIMIT,
            # A group of its own: a kill reaches whatever it starts, and the terminal's signals do not reach it.
            start_new_session=True,
            # A process that reads uploads sees no password, and of our variables what tells of backends alone.
            env=workspaces.environment(workspace, tuple(BACKEND_VARIABLES)),
        )
        return cls(process, workspace)

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.returncode is None

    async def run(
        self, spec: dict[str, Any], progress: Callable[[str, float], Awaitable[None]], seconds: float
    ) -> float:
        """Run the stage that ``spec`` describes; gives the seconds it took. Whatever happens, it is gone then.

        Raises:
            RefusedError: the stage refused its input.
            StageCrashedError: it ended without an answer.
            StageTimeoutError: it took longer than ``seconds``.
        """
        try:
            async with asyncio.timeout(seconds):
                return await self._answer(spec, progress)
        except TimeoutError:
            raise StageTimeoutError(
                f"Stage {spec['stage']} took longer than {seconds:.0f} s.",
                advice="Use fewer or smaller photos, or raise SPECIMAP_STAGE_SECONDS.",
                stage=spec["stage"],
            ) from None
        finally:
            await self.kill()

    async def _answer(self, spec: dict[str, Any], progress: Callable[[str, float], Awaitable[None]]) -> float:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with suppress(ConnectionError):  # it has ended: the reading below tells how
            self._process.stdin.write(json_text(spec).encode() + b"\n")
            await self._process.stdin.drain()
        async for line in self._process.stdout:
            event = json.loads(line)
            if event["event"] == "progress":
                await progress(event["stage"], event["share"])
            elif event["event"] == "done":
                return float(event["seconds"])
            elif event["event"] == "failed":
                raise RefusedError(event["error"])
        code = await self._process.wait()
        await self._reading
        raise StageCrashedError(_reason(code), self._tail)

    async def kill(self) -> None:
        """End it and all it started, at once."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        await self._process.wait()
        await self._reading

    async def end(self) -> None:
        """The same, and remove its workspace."""
        await self.kill()
        await asyncio.to_thread(self.workspace.remove)

    async def _read_errors(self) -> None:
        assert self._process.stderr is not None
        while True:
            try:
                line = await self._process.stderr.readline()
            except ValueError:  # a line beyond the limit
                continue
            if not line:
                return
            self._tail.append(line.decode(errors="replace").rstrip()[:500])


def _reason(code: int) -> str:
    if code < 0:
        name = signal.Signals(-code).name if -code in signal.valid_signals() else str(-code)
        hint = " (often: out of memory)" if -code == signal.SIGKILL else ""
        return f"was ended by {name}{hint}"
    return f"ended with status {code}"


class Processes:
    """Gives out processes and keeps some in reserve."""

    def __init__(self, workspaces: Workspaces, command: Sequence[str] = COMMAND, *, memory_bytes: int = 0) -> None:
        self._command = (*command, str(memory_bytes), str(os.getpid()))
        self._cells = workspaces
        self._spares: list[StageProcess] = []
        self._starting: asyncio.Task[None] | None = None

    async def take(self) -> StageProcess:
        """A process, the warmest there is."""
        if not self._spares and self._starting is not None:
            await self._starting
        while self._spares:
            spare = self._spares.pop(0)
            if spare.alive:
                return spare
            await spare.end()
        return await StageProcess.start(self._command, self._cells)

    def prepare(self) -> None:
        """Start processes for the next stages, until enough are there."""
        if self._starting is None or self._starting.done():
            self._starting = asyncio.create_task(self._prepare())

    async def _prepare(self) -> None:
        while len(self._spares) < SPARES:
            self._spares.append(await StageProcess.start(self._command, self._cells))

    async def close(self) -> None:
        """End those in reserve."""
        if self._starting is not None:
            with suppress(OSError, SpecimapError):
                await self._starting
        for spare in self._spares:
            await spare.end()
        self._spares.clear()
