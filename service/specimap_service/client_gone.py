"""Clients that go away while they wait for an answer."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable
from contextlib import suppress
from typing import TypeVar

from starlette.requests import ClientDisconnect
from starlette.types import Receive

T = TypeVar("T")


async def disconnected(receive: Receive) -> None:
    """Wait until the client has gone; what it still sends is discarded."""
    while (await receive())["type"] != "http.disconnect":
        pass


async def while_connected(receive: Receive, waiting: Awaitable[T]) -> T:
    """Return what ``waiting`` gives; cancel it where the client goes away before. The request's body has been read.

    Raises ClientDisconnect: it went away.
    """
    gone, work = asyncio.ensure_future(disconnected(receive)), asyncio.ensure_future(waiting)
    try:
        await asyncio.wait((gone, work), return_when=asyncio.FIRST_COMPLETED)
        if not work.done():
            raise ClientDisconnect
        return work.result()
    finally:
        for task in (gone, work):
            if not task.done():
                task.cancel()
                with suppress(asyncio.CancelledError):
                    await task
