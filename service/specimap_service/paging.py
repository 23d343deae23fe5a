"""Lists in pages: newest first, continued after the last id seen."""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Generic, TypeVar

from fastapi import Query
from pydantic import AfterValidator, AwareDatetime, BaseModel, Field

Item = TypeVar("Item")
Limit = Annotated[int, Query(ge=1, le=500, description="Most items of a page.")]
After = Annotated[
    str | None,
    Query(pattern=r"^[a-z]{2,5}_[0-9a-z]{26}$", description="`next` of the page before; without it the first page."),
]


def _year_in_range(value: datetime.datetime) -> datetime.datetime:
    if not 1900 <= value.year <= 9000:
        raise ValueError("a year from 1900 to 9000")
    return value


Moment = Annotated[AwareDatetime, AfterValidator(_year_in_range)]
"""A time with its zone, far enough from the calendar's ends to have a UTC time."""


InProject = Annotated[
    str | None,
    Query(
        pattern=r"^[A-Za-z0-9._-]{1,64}$",
        description="Only those of this project, by its id or name; without it, of all that the key sees.",
    ),
]


class Page(BaseModel, Generic[Item]):
    """One page."""

    @classmethod
    def model_parametrized_name(cls, params: tuple[Any, ...]) -> str:
        """Name the page after its items, as the API's description shows them."""
        return f"{params[0].model_config.get('title', params[0].__name__)}Page"

    items: list[Item]
    next: str | None = Field(description="Give it as `after` for the next page; null on the last one.")


def page_of(found: list[Item], ids: list[str], limit: int) -> Page[Item]:
    """Make a page from up to ``limit + 1`` items and their ids: one more than fits means that there is a next page."""
    more = len(found) > limit
    return Page(items=found[:limit], next=ids[limit - 1] if more else None)
