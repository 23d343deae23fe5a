"""Turns that are fair between keys, and bounded."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import AsyncExitStack

import pytest

from specimap_service.errors import OverloadedError, TooManyAtOnceError
from specimap_service.fair_turns import FairTurns, TurnBounds

ROOMY = TurnBounds(at_once=3, of_key=2, waiting=1000, waiting_of_key=1000)


async def settled() -> None:
    """Let all tasks go as far as they can."""
    for _ in range(20):
        await asyncio.sleep(0)


def test_a_key_never_holds_all_turns_whatever_it_asks_for() -> None:
    async def check() -> None:
        turns, order, stop = FairTurns(ROOMY), list[str](), asyncio.Event()

        async def work(key: str) -> None:
            async with turns.turn_async(key):
                order.append(key)
                await stop.wait()

        hostile = [asyncio.create_task(work("hostile")) for _ in range(50)]
        await settled()
        assert order == ["hostile"] * 2
        other = [asyncio.create_task(work("other")) for _ in range(2)]
        await settled()
        assert order == ["hostile", "hostile", "other"]
        stop.set()
        await asyncio.gather(*hostile, *other)
        # The second of the other key came with the next ones, before most of the 48 that had come earlier.
        assert order[:5].count("other") == 2
        assert (len(order), turns.waiting) == (52, 0)

    asyncio.run(check())


def test_waiting_keys_take_turns() -> None:
    async def check() -> None:
        turns, order = FairTurns(TurnBounds(1, 1, 100, 100)), list[str]()

        async def work(key: str) -> None:
            async with turns.turn_async(key):
                order.append(key)
                await settled()

        tasks = [asyncio.create_task(work(key)) for key in ["a"] * 4 + ["b"] * 3 + ["c"]]
        await asyncio.gather(*tasks)
        assert "".join(order) == "abcababa"

    asyncio.run(check())


def test_too_many_are_refused_at_once_with_how_long_to_wait() -> None:
    async def check() -> None:
        turns = FairTurns(TurnBounds(at_once=2, of_key=1, waiting=4, waiting_of_key=3, retry_after_s=7))
        stop = asyncio.Event()

        async def work(key: str) -> None:
            async with turns.turn_async(key):
                await stop.wait()

        tasks = [asyncio.create_task(work("a")) for _ in range(4)]
        await settled()
        with pytest.raises(TooManyAtOnceError) as refused:
            await turns.run("a", int)
        assert (refused.value.details["retry_after_s"], refused.value.details["limit"]) == (7, 3)
        tasks += [asyncio.create_task(work(key)) for key in ("b", "c")]  # b is given the second turn, c waits
        await settled()
        assert turns.waiting == 4
        for key in ("b", "d"):
            with pytest.raises(OverloadedError) as full:
                await turns.run(key, int)
            assert full.value.details["retry_after_s"] == 7
        assert turns.waiting == 4
        # What has begun is never refused.
        begun = asyncio.create_task(turns.go_on("d", int))
        await settled()
        assert (turns.waiting, begun.done()) == (5, False)
        stop.set()
        await asyncio.gather(*tasks)
        assert await begun == 0

    asyncio.run(check())


def test_one_that_goes_away_leaves_its_place() -> None:
    async def check() -> None:
        turns = FairTurns(TurnBounds(1, 1, 2, 2))
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(turns.turn_async("a"))
            waiting = [asyncio.create_task(turns.run("b", int)) for _ in range(2)]
            await settled()
            waiting[0].cancel()
            await settled()
            assert turns.waiting == 1
            last = asyncio.create_task(turns.run("c", int))
            await settled()
            assert not last.done()
        # Cancelled in the very moment in which it is given its turn: the turn goes on to the next.
        waiting[1].cancel()
        assert await last == 0
        assert turns.waiting == 0

    asyncio.run(check())


def test_threads_wait_beside_coroutines_and_work_fails_as_it_does() -> None:
    turns, entered, stop = FairTurns(TurnBounds(1, 1, 10, 10)), threading.Event(), threading.Event()

    def hold() -> None:
        with turns.turn("a"):
            entered.set()
            stop.wait(20)

    async def ask() -> None:
        asking: Coroutine[None, None, int] = turns.run("b", int, "no number")
        task = asyncio.create_task(asking)
        await settled()
        assert turns.waiting == 1
        stop.set()
        with pytest.raises(ValueError, match="no number"):
            await task

    with ThreadPoolExecutor(1) as pool:
        held = pool.submit(hold)
        assert entered.wait(20)
        asyncio.run(ask())
        held.result()
    turns.close()
    with pytest.raises(CancelledError), turns.turn("a"):
        pass
