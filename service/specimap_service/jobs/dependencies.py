"""The events of jobs that requests follow."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

from fastapi import Depends, FastAPI

from specimap_service.app_state import AppState
from specimap_service.auth.dependencies import Permitted
from specimap_service.context import AppContext
from specimap_service.feature import Feature
from specimap_service.jobs.events import JobEvents, Streams

EVENTS = AppState[JobEvents]("job_events")
STREAMS = AppState[Streams]("streams")


def _open(app: FastAPI, context: AppContext) -> None:
    EVENTS.set(app, JobEvents(context.database))
    STREAMS.set(app, Streams(context.settings.max_streams_per_key))


@asynccontextmanager
async def _running(app: FastAPI) -> AsyncIterator[None]:
    events = EVENTS.of(app)
    events.start()
    try:
        yield
    finally:
        await asyncio.to_thread(events.stop)


async def _place(principal: Permitted, streams: Annotated[Streams, Depends(STREAMS.of_request)]) -> AsyncIterator[None]:
    with streams.place(principal.key_id):
        yield


FEATURE = Feature(_open, _running)
EventsDep = Annotated[JobEvents, Depends(EVENTS.of_request)]
StreamPlace = Annotated[None, Depends(_place)]
"""One of the streams that the request's key may follow, held until the answer has ended."""
