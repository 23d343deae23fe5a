"""Open clouds, pictures drawn of them, and the turns at reading them."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, FastAPI

from specimap_service.app_state import AppState
from specimap_service.clouds.band_copies import BandCopies
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.clouds.picture_queue import PictureQueue
from specimap_service.clouds.reading import Reading
from specimap_service.context import AppContext
from specimap_service.feature import Feature

OPEN_CLOUDS = AppState[OpenClouds]("open_clouds")
PICTURES = AppState[PictureQueue]("pictures")
READING = AppState[Reading]("reading")
BAND_COPIES = AppState[BandCopies]("band_copies")


def _open(app: FastAPI, context: AppContext) -> None:
    OPEN_CLOUDS.set(app, OpenClouds(context.storage, context.database))
    PICTURES.set(app, PictureQueue(context.settings))
    READING.set(app, Reading())
    BAND_COPIES.set(app, BandCopies(context.settings, context.database))


FEATURE = Feature(_open, lambda app: BAND_COPIES.of(app).running())
CloudsDep = Annotated[OpenClouds, Depends(OPEN_CLOUDS.of_request)]
PicturesDep = Annotated[PictureQueue, Depends(PICTURES.of_request)]
ReadingDep = Annotated[Reading, Depends(READING.of_request)]
BandCopiesDep = Annotated[BandCopies, Depends(BAND_COPIES.of_request)]
