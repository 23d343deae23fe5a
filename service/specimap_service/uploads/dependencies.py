"""Uploads of the app, and the task that removes expired ones while it runs."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Annotated

from fastapi import Depends, FastAPI

from specimap_core.errors import SpecimapError
from specimap_infra.logs import logger
from specimap_service.acquisitions.dependencies import INTAKE, JUDGE, UNFINISHED_UPLOADS
from specimap_service.app_state import AppState
from specimap_service.context import AppContext
from specimap_service.feature import Feature
from specimap_service.uploads.files import UploadBytes, UploadFiles
from specimap_service.uploads.lifecycle import Uploads
from specimap_service.uploads.parts import UploadParts
from specimap_service.uploads.sweeping import sweep

SWEEP_SECONDS = 300.0
UPLOADS = AppState[Uploads]("uploads")


def _open(app: FastAPI, context: AppContext) -> None:
    files = _bytes(context)
    UPLOADS.set(app, Uploads(context, files, JUDGE.of(app), INTAKE.of(app)))
    UNFINISHED_UPLOADS.set(app, files)


def _bytes(context: AppContext) -> UploadBytes:
    """Keep uploads on this machine's disk where no other one serves: SQLite is for one machine."""
    folder = context.settings.scratch / "uploads"
    if context.database.engine.dialect.name == "sqlite":
        return UploadFiles(folder)
    return UploadParts(context.database, context.storage, folder)


@asynccontextmanager
async def _running(app: FastAPI) -> AsyncIterator[None]:
    task = asyncio.create_task(_sweep_forever(UPLOADS.of(app)))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task


async def _sweep_forever(uploads: Uploads) -> None:
    while True:
        try:
            await asyncio.to_thread(sweep, uploads)
        except (SpecimapError, OSError):
            logger().exception("sweeping of uploads failed")
        await asyncio.sleep(SWEEP_SECONDS)


FEATURE = Feature(_open, _running)
UploadsDep = Annotated[Uploads, Depends(UPLOADS.of_request)]
