"""Features of the app: each makes the objects that its requests share, and closes them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass

from fastapi import FastAPI

from specimap_service.context import AppContext


def _nothing(app: FastAPI) -> AbstractAsyncContextManager[None]:
    return nullcontext()


@dataclass(frozen=True)
class Feature:
    """Setup and shutdown of a feature, apart from its routes.

    ``open`` puts the feature's objects into the app's state when the app is created. ``running`` is entered when the
    app starts to serve and left when it stops: it runs background tasks, and closes the objects that ``open`` made.
    """

    open: Callable[[FastAPI, AppContext], None]
    running: Callable[[FastAPI], AbstractAsyncContextManager[None]] = _nothing
