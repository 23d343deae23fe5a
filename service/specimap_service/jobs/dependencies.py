"""The events of jobs that requests follow."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, FastAPI

from specimap_service.app_state import AppState
from specimap_service.context import AppContext
from specimap_service.feature import Feature
from specimap_service.jobs.events import JobEvents

EVENTS = AppState[JobEvents]("job_events")


def _open(app: FastAPI, context: AppContext) -> None:
    EVENTS.set(app, JobEvents(context.database))


FEATURE = Feature(_open)
EventsDep = Annotated[JobEvents, Depends(EVENTS.of_request)]
