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
    """What ``create_app`` needs of a feature, its routes apart.

    ``open`` puts the feature's objects into the app's state when the app is created. ``running`` is entered when the
    app starts to serve and left when it stops: it runs what goes on in the background and closes what ``open`` made.
    """

    open: Callable[[FastAPI, AppContext], None]
    running: Callable[[FastAPI], AbstractAsyncContextManager[None]] = _nothing
