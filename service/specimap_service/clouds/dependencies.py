"""Open clouds, pictures drawn of them, and the turns at reading them."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, FastAPI

from specimap_service.app_state import AppState
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.clouds.picture_queue import PictureQueue
from specimap_service.clouds.reading import Reading
from specimap_service.context import AppContext
from specimap_service.feature import Feature

OPEN_CLOUDS = AppState[OpenClouds]("open_clouds")
PICTURES = AppState[PictureQueue]("pictures")
READING = AppState[Reading]("reading")


def _open(app: FastAPI, context: AppContext) -> None:
    OPEN_CLOUDS.set(app, OpenClouds(context.storage, context.database))
    PICTURES.set(app, PictureQueue(context.settings))
    READING.set(app, Reading())


FEATURE = Feature(_open)
CloudsDep = Annotated[OpenClouds, Depends(OPEN_CLOUDS.of_request)]
PicturesDep = Annotated[PictureQueue, Depends(PICTURES.of_request)]
ReadingDep = Annotated[Reading, Depends(READING.of_request)]
