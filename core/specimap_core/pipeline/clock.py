"""Times the stages and passes their progress on."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager

from specimap_core.errors import CancelledError
from specimap_core.pipeline.failures import as_stage_failure

STAGES = ("reconstruct", "adjust", "render", "register")
Progress = Callable[[str, float], None]


class Clock:
    """Times the stages, passes progress on, and stops where a stop was asked for.

    ``seconds`` and ``reused`` tell of stages that ran before, in another process.
    """

    def __init__(
        self,
        progress: Progress,
        cancelled: Callable[[], bool],
        *,
        seconds: Mapping[str, float] | None = None,
        reused: Sequence[str] = (),
    ) -> None:
        self.seconds: dict[str, float] = dict(seconds or {})
        self.reused: list[str] = list(reused)
        self._progress = progress
        self._cancelled = cancelled
        self._running = STAGES[0], time.perf_counter()

    def report(self, stage: str, share: float) -> None:
        """Say how far a stage is.

        Raises:
            CancelledError: a stop was asked for.
        """
        if self._cancelled():
            raise CancelledError(
                f"Stopped in stage {stage}.", advice="Run again to go on from the last finished stage.", stage=stage
            )
        self._progress(stage, min(max(share, 0.0), 1.0))

    def so_far(self) -> dict[str, float]:
        """Seconds of the finished stages and of the one that runs."""
        name, start = self._running
        return {**self.seconds, name: round(time.perf_counter() - start, 3)}

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[float], None]]:
        """Time a stage; yields its progress function. What a library raises in it becomes a StageFailedError."""
        self._running = name, time.perf_counter()
        self.report(name, 0.0)
        with as_stage_failure(name):
            yield lambda share: self.report(name, share)
        self.seconds = self.so_far()
        self.report(name, 1.0)
