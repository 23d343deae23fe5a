"""Open clouds, pictures drawn of them, and the limit on parsing large selections."""

from __future__ import annotations

from typing import Annotated

from anyio import CapacityLimiter
from fastapi import Depends, FastAPI

from specimap_service.app_state import AppState
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.clouds.picture_cache import PictureCache
from specimap_service.context import AppContext
from specimap_service.feature import Feature

OPEN_CLOUDS = AppState[OpenClouds]("open_clouds")
PICTURES = AppState[PictureCache]("pictures")
PARSING = AppState[CapacityLimiter]("parsing")
"""Large selections are parsed one at a time: each takes the processor for a while."""


def _open(app: FastAPI, context: AppContext) -> None:
    OPEN_CLOUDS.set(app, OpenClouds(context.storage, context.database))
    PICTURES.set(app, PictureCache())
    PARSING.set(app, CapacityLimiter(1))


FEATURE = Feature(_open)
CloudsDep = Annotated[OpenClouds, Depends(OPEN_CLOUDS.of_request)]
PicturesDep = Annotated[PictureCache, Depends(PICTURES.of_request)]
ParsingDep = Annotated[CapacityLimiter, Depends(PARSING.of_request)]
