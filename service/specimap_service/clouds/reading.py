"""Turns at reading spectra: what reads and encodes many values waits in a queue that is fair between keys."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from specimap_service.fair_turns import FairTurns, TurnBounds

P = ParamSpec("P")
T = TypeVar("T")

READS = TurnBounds(at_once=3, of_key=2, waiting=512, waiting_of_key=128, retry_after_s=1)
LONG_ANSWERS = TurnBounds(at_once=16, of_key=4, waiting=64, waiting_of_key=16)
"""Answers of several batches: each holds up to 50 MB as long as its client takes to receive it."""
PARSES = TurnBounds(at_once=2, of_key=1, waiting=64, waiting_of_key=32, retry_after_s=1)
"""Selections of up to 4 MiB: each takes the processor for a while."""


class Reading:
    """The turns of one app."""

    def __init__(self) -> None:
        self.parses = FairTurns(PARSES)
        self._reads, self._long = FairTurns(READS), FairTurns(LONG_ANSWERS)

    async def run(self, key: str, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """Run what reads and encodes an answer, or its first part, in a turn of the key.

        Raises TooManyAtOnceError, OverloadedError, and whatever the work raises.
        """
        return await self._reads.run(key, work, *arguments, **named)

    def pace(self, key: str) -> KeyPace:
        """Return the pace at which a long answer to a key is made."""
        return KeyPace(key, self._reads, self._long)


@dataclass(frozen=True)
class KeyPace:
    """A :class:`~specimap_service.array_responses.Pace`: each piece takes a turn of the key."""

    key: str
    reads: FairTurns
    long: FairTurns

    def sending(self) -> AbstractAsyncContextManager[None]:
        """Hold one of the key's long answers. Raises TooManyAtOnceError, OverloadedError."""
        return self.long.turn_async(self.key)

    async def read(self, work: Callable[..., bytes], *arguments: Any) -> bytes:
        """Make one piece; it is never refused, since the answer has begun."""
        return await self.reads.go_on(self.key, work, *arguments)
