"""uploads."""

from __future__ import annotations

from fastapi import APIRouter

router = APIRouter(prefix="/v1", tags=["uploads"])


def mount(app: object, context: object) -> None:
    """To be filled."""
