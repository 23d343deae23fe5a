"""Lists in pages, in either order, continued after the last item seen.

Most lists answer with a page. Those that answer with all items, as they did before there were pages, take the same
parameters, and name the next page in the header `Link`.
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Generic, Literal, TypeVar

import sqlalchemy as sa
from fastapi import Query, Request, Response
from pydantic import AfterValidator, AwareDatetime, BaseModel, Field, WithJsonSchema

Item = TypeVar("Item")
Limit = Annotated[int, Query(ge=1, le=500, description="Most items of a page.")]
After = Annotated[
    str | None,
    Query(pattern=r"^[a-z]{2,5}_[0-9a-z]{26}$", description="`next` of the page before; without it the first page."),
]
MaybeLimit = Annotated[
    int | None,
    Query(ge=1, le=500, description="Most items of a page; without it all. `Link` names the next page (RFC 8288)."),
]
Sort = Annotated[
    Literal["created_at", "-created_at"],
    Query(description="By time of creation: `created_at` oldest first, `-created_at` newest first."),
]


def _year_in_range(value: datetime.datetime) -> datetime.datetime:
    if not 1900 <= value.year <= 9000:
        raise ValueError("a year from 1900 to 9000")
    return value


Moment = Annotated[
    AwareDatetime,
    AfterValidator(_year_in_range),
    # 1900 to 8999: the one year more would make the pattern longer than it is worth.
    WithJsonSchema({"type": "string", "format": "date-time", "pattern": "^(19|[2-8][0-9])[0-9]{2}-"}),
]
"""A time with its zone, far enough from the calendar's ends to have a UTC time."""

CreatedAfter = Annotated[Moment | None, Query(description="Only those created at this time or later.")]
CreatedBefore = Annotated[Moment | None, Query(description="Only those created before this time.")]
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


def paged(query: sa.Select[Any], column: Any, after: Any, limit: int | None, sort: str) -> sa.Select[Any]:
    """Order a query by a column that is in order of time, and limit it to a page and one item more."""
    newest_first = sort.startswith("-")
    if after is not None:
        query = query.where(column < after if newest_first else column > after)
    query = query.order_by(column.desc() if newest_first else column)
    return query if limit is None else query.limit(limit + 1)


def part_of(
    items: Sequence[Item], place: Callable[[Item], Any], after: Any, limit: int | None, sort: str
) -> list[Item]:
    """Do as :func:`paged` does with items that are at hand; ``place`` tells what they are ordered by."""
    backwards = sort.startswith("-")
    found = sorted(items, key=place, reverse=backwards)
    if after is not None:
        found = [item for item in found if (place(item) < after if backwards else place(item) > after)]
    return found if limit is None else found[: limit + 1]


def listed(
    request: Request, response: Response, found: list[Item], ids: Sequence[Any], limit: int | None
) -> list[Item]:
    """Make the answer of a list without a page's frame, from up to ``limit + 1`` items and their ids."""
    if limit is None or len(found) <= limit:
        return found
    url = request.url.include_query_params(after=ids[limit - 1])
    response.headers["Link"] = f'<{url.path}?{url.query}>; rel="next"'
    return found[:limit]
