"""Typed places in ``app.state`` for the objects that an app's requests share."""

from __future__ import annotations

from typing import Generic, TypeVar

from fastapi import FastAPI, Request

T = TypeVar("T")


class AppState(Generic[T]):
    """One object of each app, under a name in ``app.state``."""

    def __init__(self, name: str) -> None:
        self._name = name

    def set(self, app: FastAPI, value: T) -> T:
        """Keep the app's object, and return it."""
        setattr(app.state, self._name, value)
        return value

    def of(self, app: FastAPI) -> T:
        """Return the app's object."""
        found: T = getattr(app.state, self._name)
        return found

    async def of_request(self, request: Request) -> T:
        """Return the object of the request's app: a dependency, ``async`` so that it takes no thread."""
        return self.of(request.app)
