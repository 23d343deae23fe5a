"""Setbacks: what went wrong while a job or an export was worked on, and when that makes it the cause.

The rule. A death speaks against a job only where the job itself can have brought it about:

- A *crash*: the process of its stage ended by itself while its worker and its machine lived on. That is an exit
  without an answer, a signal that a program raises by its own doing (SIGSEGV, SIGABRT, ...), or SIGKILL while the
  kernel counted a process killed for want of memory. ``SPECIMAP_STARTS`` crashes in a row fail the job.
- An *interruption*: the process was ended from outside (SIGKILL, SIGTERM, ... and no sign of want of memory), or its
  worker died. That says nothing about the job: an operator, a deployment or a power cut does the same. Yet a job may
  take its worker along, as where the whole container is killed for want of memory, so each interruption is noted, with
  the worker's name, and the job is put off for a growing time, in which the others go on. ``SPECIMAP_INTERRUPTIONS`` in
  a row fail the job: under kills at random, that four of five attempts do not survive, fewer than one stage in 800
  meets the default of 30. A job that takes its worker along each time is found after some twelve minutes.
- A shutdown, an outage of the database or the storage, or a lease that was lost by a worker which lives on: not a
  setback. A worker that was taken for dead and comes back takes its interruptions back.

"In a row" ends with a finished stage: a job that gets on is sound. Whatever hands a job on without a count is bounded
by ``MOST_ATTEMPTS`` of one stage, so that no job goes round for ever.
"""

from __future__ import annotations

import dataclasses
import signal
from dataclasses import dataclass
from typing import Any, Literal

from specimap_infra.errors import WorkerCrashedError

MOST_ATTEMPTS = 100
"""Times that workers may take up one stage of a job, for whatever reason."""
LONGEST_PAUSE_SECONDS = 30.0
FROM_OUTSIDE = frozenset({signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT})
"""Signals that come from another process; a program's own faults raise others."""
Cause = Literal["crashes", "interruptions", "attempts"]


@dataclass(frozen=True)
class Setbacks:
    """The setbacks since the last finished stage, as the row of a job or an export keeps them.

    ``crashes`` and ``interruptions`` hold a name for each, so that one that is told twice counts once; an interruption
    by a worker's death has the worker's name. ``retry_at``: when to go on, in seconds of the database's clock.
    """

    attempts: int = 0
    crashes: tuple[str, ...] = ()
    interruptions: tuple[str, ...] = ()
    retry_at: float = 0.0

    @classmethod
    def of(cls, stored: dict[str, Any]) -> Setbacks:
        """Read what :meth:`stored` gave; an empty object is none."""
        return cls(
            int(stored.get("attempts", 0)),
            tuple(stored.get("crashes", ())),
            tuple(stored.get("interruptions", ())),
            float(stored.get("retry_at", 0.0)),
        )

    def stored(self) -> dict[str, Any]:
        """Return JSON for the row."""
        return dataclasses.asdict(self) | {"crashes": list(self.crashes), "interruptions": list(self.interruptions)}

    def attempted(self) -> Setbacks:
        """Count an attempt."""
        return dataclasses.replace(self, attempts=self.attempts + 1)

    def crashed(self, name: str) -> Setbacks:
        """Add a crash."""
        return dataclasses.replace(self, crashes=_with(self.crashes, name))

    def interrupted(self, name: str, now: float) -> Setbacks:
        """Add an interruption; the work goes on at ``now`` or later, by the database's clock."""
        names = _with(self.interruptions, name)
        return dataclasses.replace(self, interruptions=names, retry_at=now + pause_seconds(len(names)))

    def without(self, name: str) -> Setbacks:
        """Take an interruption back: its worker lives."""
        return dataclasses.replace(self, interruptions=tuple(n for n in self.interruptions if n != name))

    def cause(self, *, crashes: int, interruptions: int) -> Cause | None:
        """Return what makes the work hopeless, given how many of each it may have; None where it goes on."""
        if len(self.crashes) >= crashes:
            return "crashes"
        if len(self.interruptions) >= interruptions:
            return "interruptions"
        return "attempts" if self.attempts > MOST_ATTEMPTS else None

    def failure(self, stage: str, reason: str, *, crashes: int, interruptions: int) -> WorkerCrashedError | None:
        """Return the error that ends a job of which :meth:`cause` says so; ``reason``: how its last process ended."""
        cause = self.cause(crashes=crashes, interruptions=interruptions)
        if cause is None:
            return None
        counts = {
            "crashes": len(self.crashes),
            "interruptions": len(self.interruptions),
            "attempts": self.attempts,
        }
        told = {
            "crashes": f"The process of stage {stage} {reason}, {counts[cause]} times in a row.",
            "interruptions": f"The process or the worker of stage {stage} {reason}, {counts[cause]} times in a row.",
            "attempts": f"Stage {stage} did not get done in {counts[cause]} attempts.",
        }
        return WorkerCrashedError(
            told[cause],
            advice="Look at the job's log; fewer or smaller photos need less memory.",
            stage=stage,
            starts=counts[cause],
            cause=cause,
        )


def pause_seconds(count: int) -> float:
    """Return how long work waits after its interruption of that number: not at all after the first one."""
    return 0.0 if count < 2 else min(2.0 ** (count - 2), LONGEST_PAUSE_SECONDS)


def ended_from_outside(status: int, *, memory_ran_out: bool) -> bool:
    """Whether a process with this exit status, minus the number of a signal, was ended by another one.

    ``memory_ran_out``: the kernel has killed some process for want of memory while this one ran.
    """
    return -status in FROM_OUTSIDE and not (-status == signal.SIGKILL and memory_ran_out)


def _with(names: tuple[str, ...], name: str) -> tuple[str, ...]:
    return names if name in names else (*names, name)
