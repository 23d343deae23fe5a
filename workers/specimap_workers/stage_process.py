"""Processes for stages: some are always kept ready, so that a stage does not wait for imports."""

from __future__ import annotations

import asyncio
import os
import signal
import sys
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from specimap_core.errors import SpecimapError
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES
from specimap_core.sandbox.json_lines import JsonLineProcess, ProcessEndedError, end_text
from specimap_infra.errors import StageTimeoutError
from specimap_infra.setbacks import ended_from_outside
from specimap_workers.memory import MemoryWatch, offer_to_memory_killer
from specimap_workers.workspaces import Workspace, Workspaces

COMMAND = (sys.executable, "-m", "specimap_workers.stage_main")
SPARES = 2
"""One for the next stage and one for that after it: rendering takes a tenth of a second, less than an import."""
TICK_SECONDS = 0.2
"""Longest time that a thread waits for a line: a thread cannot be cancelled."""


class StageCrashedError(Exception):
    """A stage's process ended without an answer; ``reason`` in words, ``tail`` its last lines.

    ``from_outside``: another process ended it, which says nothing about the job.
    """

    def __init__(self, reason: str, tail: Sequence[str], *, from_outside: bool = False) -> None:
        super().__init__(reason)
        self.reason = reason
        self.tail = list(tail)
        self.from_outside = from_outside


class RefusedError(Exception):
    """A stage refused its input; ``error`` as ``SpecimapError.as_dict`` gives it."""

    def __init__(self, error: dict[str, Any]) -> None:
        super().__init__(str(error.get("message")))
        self.error = error


class StageProcess:
    """One process, for one stage."""

    def __init__(self, process: JsonLineProcess, workspace: Workspace) -> None:
        self._process = process
        self.workspace = workspace

    @classmethod
    async def start(cls, command: Sequence[str], workspaces: Workspaces) -> StageProcess:
        """Start it in a workspace of its own; it loads its libraries meanwhile."""
        workspace = await asyncio.to_thread(workspaces.new)
        confined = await asyncio.to_thread(partial(workspaces.confined, command, workspace, backends=True))
        # It reads uploads, so it sees no password, and of Specimap's variables those of the backends alone. It is
        # started in this thread, not in one of a pool: it ends with the thread that started it.
        process = JsonLineProcess(confined, env=workspaces.environment(workspace, tuple(BACKEND_VARIABLES)))
        offer_to_memory_killer(process.pid)
        return cls(process, workspace)

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.alive

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
                await asyncio.to_thread(self._process.send, spec, seconds)
                return await self._answer(progress)
        except TimeoutError:
            raise StageTimeoutError(
                f"Stage {spec['stage']} took longer than {seconds:.0f} s.",
                advice="Use fewer or smaller photos, or raise SPECIMAP_STAGE_SECONDS.",
                stage=spec["stage"],
            ) from None
        finally:
            await self.kill()

    async def _answer(self, progress: Callable[[str, float], Awaitable[None]]) -> float:
        memory = MemoryWatch()
        while True:
            try:
                event = await asyncio.to_thread(self._process.receive, TICK_SECONDS)
            except TimeoutError:
                continue
            except ProcessEndedError as end:
                ran_out = memory.ran_out()
                outside = ended_from_outside(end.status, memory_ran_out=ran_out)
                raise StageCrashedError(_reason(end.status, ran_out), end.tail, from_outside=outside) from end
            if event["event"] == "progress":
                await progress(event["stage"], event["share"])
            elif event["event"] == "done":
                return float(event["seconds"])
            elif event["event"] == "failed":
                raise RefusedError(event["error"])

    async def kill(self) -> None:
        """End it and all it started, at once."""
        self._process.kill()
        await asyncio.to_thread(self._process.close)

    async def end(self) -> None:
        """The same, and remove its workspace."""
        await self.kill()
        await asyncio.to_thread(self.workspace.remove)


def _reason(status: int, memory_ran_out: bool) -> str:
    hint = " (out of memory)" if status == -signal.SIGKILL and memory_ran_out else ""
    return f"{'was ended' if status < 0 else 'ended'} {end_text(status)}{hint}"


class Processes:
    """Gives out processes and keeps some in reserve."""

    def __init__(self, workspaces: Workspaces, command: Sequence[str] = COMMAND, *, memory_bytes: int = 0) -> None:
        self._command = (*command, str(memory_bytes), str(os.getpid()))
        self._workspaces = workspaces
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
        return await StageProcess.start(self._command, self._workspaces)

    def prepare(self) -> None:
        """Start processes for the next stages, until enough are there."""
        if self._starting is None or self._starting.done():
            self._starting = asyncio.create_task(self._prepare())

    async def _prepare(self) -> None:
        while len(self._spares) < SPARES:
            self._spares.append(await StageProcess.start(self._command, self._workspaces))

    async def close(self) -> None:
        """End those in reserve."""
        if self._starting is not None:
            with suppress(OSError, SpecimapError):
                await self._starting
        for spare in self._spares:
            await spare.end()
        self._spares.clear()
