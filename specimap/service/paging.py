"""Lists in pages: newest first, continued after the last id seen."""

from __future__ import annotations

from typing import Annotated, Generic, TypeVar

from fastapi import Query
from pydantic import BaseModel, Field

Item = TypeVar("Item")
Limit = Annotated[int, Query(ge=1, le=500, description="Most items of a page.")]
After = Annotated[str | None, Query(max_length=64, description="`next` of the page before; without it the first page.")]


class Page(BaseModel, Generic[Item]):
    """One page."""

    items: list[Item]
    next: str | None = Field(description="Give it as `after` for the next page; null on the last one.")


def page_of(found: list[Item], ids: list[str], limit: int) -> Page[Item]:
    """A page from up to ``limit + 1`` items and their ids: one more than fits tells that there is a next page."""
    more = len(found) > limit
    return Page(items=found[:limit], next=ids[limit - 1] if more else None)
