"""Turns at asking the hospital's systems, which may take seconds to answer."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated

from fastapi import Depends, FastAPI

from specimap_service.app_state import AppState
from specimap_service.context import AppContext
from specimap_service.fair_turns import FairTurns, TurnBounds
from specimap_service.feature import Feature

ASKING = AppState[FairTurns]("asking_hospital")
ASKED = TurnBounds(at_once=4, of_key=2, waiting=32, waiting_of_key=4, retry_after_s=5)

MAKING = AppState[FairTurns]("making_dicom")
MADE = TurnBounds(at_once=2, of_key=1, waiting=8, waiting_of_key=2, retry_after_s=10)
"""DICOM objects of a result made while somebody waits for them: some seconds, and a processor."""


def _open(app: FastAPI, context: AppContext) -> None:
    ASKING.set(app, FairTurns(ASKED))
    MAKING.set(app, FairTurns(MADE))


@asynccontextmanager
async def _running(app: FastAPI) -> AsyncIterator[None]:
    try:
        yield
    finally:
        MAKING.of(app).close()
        ASKING.of(app).close()


FEATURE = Feature(_open, _running)
AskingDep = Annotated[FairTurns, Depends(ASKING.of_request)]
MakingDep = Annotated[FairTurns, Depends(MAKING.of_request)]
