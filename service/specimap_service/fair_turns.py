"""Turns at work that takes the processor or memory for a while, shared fairly between keys, and bounded.

A key that asks for much waits for itself: the next turn goes to the key that holds the fewest, and no key may hold all.
"""

from __future__ import annotations

import asyncio
import threading
from collections import Counter, deque
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import Future
from contextlib import AsyncExitStack, asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from typing import ParamSpec, TypeVar

from anyio import CapacityLimiter, to_thread
from starlette.types import Receive

from specimap_service.client_gone import while_connected
from specimap_service.errors import OverloadedError, TooManyAtOnceError

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True)
class TurnBounds:
    """Most turns ``at_once``, of them most ``of_key``; and most that wait for one, of all keys and of one.

    ``retry_after_s``: what a refused client is told to wait.
    """

    at_once: int
    of_key: int
    waiting: int
    waiting_of_key: int
    retry_after_s: int = 2


@dataclass(eq=False)
class _Ticket:
    key: str
    given: bool = False
    future: Future[None] = field(default_factory=Future)


class FairTurns:
    """Turns by key. Threads and coroutines may wait for them side by side; a coroutine takes no thread meanwhile."""

    def __init__(self, bounds: TurnBounds) -> None:
        self.bounds = bounds
        self._lock = threading.Lock()
        self._held: Counter[str] = Counter()
        # Only keys that wait; and the number of the turn that was last given to each key that waits or holds one.
        self._waiting: dict[str, deque[_Ticket]] = {}
        self._last: dict[str, int] = {}
        self._given = 0
        self._closed = False
        self._threads = CapacityLimiter(bounds.at_once)

    @contextmanager
    def turn(self, key: str) -> Iterator[None]:
        """Wait in this thread, and hold a turn within the block. How many threads wait is bounded by the caller.

        Raises:
            concurrent.futures.CancelledError: :meth:`close` was called.
        """
        ticket = self._ask(key, refusable=False)
        try:
            ticket.future.result()
            yield
        finally:
            self._give_back(ticket)

    @asynccontextmanager
    async def turn_async(self, key: str, *, refusable: bool = True) -> AsyncIterator[None]:
        """Wait in a coroutine, and hold a turn within the block.

        ``refusable``: False for work that has begun, and must not be refused any more.

        Raises:
            TooManyAtOnceError: too many of this key wait. OverloadedError: too many of all keys do.
        """
        ticket = self._ask(key, refusable=refusable)
        try:
            if not ticket.given:
                await asyncio.wrap_future(ticket.future)
            yield
        finally:
            self._give_back(ticket)

    async def run_while(self, receive: Receive, key: str, work: Callable[[], T]) -> T:
        """Run blocking work as :meth:`run` does, unless the client goes away while it waits for its turn.

        Work that has begun goes on to its end: it would leave what is half done. The request's body has been read.

        Raises ClientDisconnect besides.
        """
        turn = AsyncExitStack()
        async with turn:
            await while_connected(receive, turn.enter_async_context(self.turn_async(key)))
            return await to_thread.run_sync(work, limiter=self._threads)

    async def run(self, key: str, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """Run blocking work in a thread, in a turn; the threads are none of those that answer other requests.

        Raises as :meth:`turn_async`, and whatever the work raises.
        """
        return await self._run(True, key, partial(work, *arguments, **named))

    async def go_on(self, key: str, work: Callable[P, T], *arguments: P.args, **named: P.kwargs) -> T:
        """Run the next part of work that has begun, as :meth:`run` does, but never refused."""
        return await self._run(False, key, partial(work, *arguments, **named))

    async def _run(self, refusable: bool, key: str, work: Callable[[], T]) -> T:
        async with self.turn_async(key, refusable=refusable):
            return await to_thread.run_sync(work, limiter=self._threads)

    @property
    def waiting(self) -> int:
        """Number of those that wait."""
        with self._lock:
            return sum(map(len, self._waiting.values()))

    def close(self) -> None:
        """Cancel those that wait, and all that come."""
        with self._lock:
            self._closed = True
            waiting, self._waiting = self._waiting, {}
        for tickets in waiting.values():
            for ticket in tickets:
                ticket.future.cancel()

    # ---- inside ---------------------------------------------------------------------------------------

    def _ask(self, key: str, *, refusable: bool) -> _Ticket:
        ticket = _Ticket(key)
        with self._lock:
            if self._closed:
                ticket.future.cancel()
                return ticket
            self._waiting.setdefault(key, deque()).append(ticket)
            self._give()
            if refusable and not ticket.given:
                try:
                    self._check_room(key)
                except BaseException:
                    self._withdraw(ticket)
                    raise
        return ticket

    def _check_room(self, key: str) -> None:
        """Raise where the last one that came to wait is one too many."""
        bounds, wait = self.bounds, self.bounds.retry_after_s
        if len(self._waiting[key]) > bounds.waiting_of_key:
            raise TooManyAtOnceError(
                f"The key has {bounds.waiting_of_key} requests of this kind waiting already.",
                advice=f"Wait {wait} s, and send fewer at a time.",
                retry_after_s=wait,
                limit=bounds.waiting_of_key,
            )
        if sum(map(len, self._waiting.values())) > bounds.waiting:
            raise OverloadedError(
                "The service has too much of this kind to do.", advice=f"Try again in {wait} s.", retry_after_s=wait
            )

    def _give_back(self, ticket: _Ticket) -> None:
        with self._lock:
            if ticket.given:
                self._held[ticket.key] -= 1
                if not self._held[ticket.key]:
                    del self._held[ticket.key]
                    if ticket.key not in self._waiting:
                        del self._last[ticket.key]
                self._give()
            else:
                self._withdraw(ticket)

    def _withdraw(self, ticket: _Ticket) -> None:
        tickets = self._waiting.get(ticket.key)
        if tickets is not None:
            with suppress(ValueError):
                tickets.remove(ticket)
            if not tickets:
                del self._waiting[ticket.key]
                if ticket.key not in self._held:
                    self._last.pop(ticket.key, None)

    def _give(self) -> None:
        """Give free turns to the keys that hold the fewest; among these, to the one whose last turn is longest ago."""
        while self._held.total() < self.bounds.at_once:
            keys = [key for key in self._waiting if self._held[key] < self.bounds.of_key]
            if not keys:
                return
            key = min(keys, key=lambda key: (self._held[key], self._last.get(key, 0)))
            ticket = self._waiting[key].popleft()
            if not self._waiting[key]:
                del self._waiting[key]
            # False for one whose coroutine was cancelled a moment ago.
            if ticket.future.set_running_or_notify_cancel():
                ticket.given = True
                self._held[key] += 1
                self._given += 1
                self._last[key] = self._given
                ticket.future.set_result(None)
