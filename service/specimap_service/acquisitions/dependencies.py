"""The judge of arriving files, the turns at taking them in, and the unfinished uploads that go with a deleted
acquisition."""

from __future__ import annotations

import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Annotated, Protocol

from fastapi import Depends, FastAPI

from specimap_service.acquisitions.judge import Judge
from specimap_service.app_state import AppState
from specimap_service.context import AppContext
from specimap_service.fair_turns import FairTurns, TurnBounds
from specimap_service.feature import Feature


class UnfinishedUploads(Protocol):
    """The bytes of unfinished uploads. The feature of uploads provides them, which itself builds on acquisitions."""

    def remove(self, upload_id: str) -> None:
        """Remove the bytes of an upload, if there are any."""


JUDGE = AppState[Judge]("judge")
INTAKE = AppState[FairTurns]("intake")
INTAKES = TurnBounds(at_once=8, of_key=4, waiting=256, waiting_of_key=64, retry_after_s=5)
"""Files that have arrived and are hashed, judged and stored: at a time, and waiting for it. A waiting one takes a
connection and its place on the disk, and no thread."""
PLACING = AppState[FairTurns]("placing")
PLACED = TurnBounds(at_once=2, of_key=1, waiting=64, waiting_of_key=8)
"""Acquisitions whose photos are placed in the dome: some hundredths of a second each, up to one with 300 photos."""
UNFINISHED_UPLOADS = AppState[UnfinishedUploads]("unfinished_uploads")


def _open(app: FastAPI, context: AppContext) -> None:
    JUDGE.set(app, Judge(context.settings, os.environ))
    INTAKE.set(app, FairTurns(INTAKES))
    PLACING.set(app, FairTurns(PLACED))


@asynccontextmanager
async def _running(app: FastAPI) -> AsyncIterator[None]:
    try:
        yield
    finally:
        PLACING.of(app).close()
        INTAKE.of(app).close()
        JUDGE.of(app).close()


FEATURE = Feature(_open, _running)
JudgeDep = Annotated[Judge, Depends(JUDGE.of_request)]
IntakeDep = Annotated[FairTurns, Depends(INTAKE.of_request)]
PlacingDep = Annotated[FairTurns, Depends(PLACING.of_request)]
UnfinishedUploadsDep = Annotated[UnfinishedUploads, Depends(UNFINISHED_UPLOADS.of_request)]
