"""Query parameters that an operation does not know are refused: a misspelt filter would let the whole list through.
So is NUL in a value, which no stored text has and PostgreSQL takes in none."""

from __future__ import annotations

from typing import Any, get_args, get_origin

from fastapi import Request
from fastapi.dependencies.utils import get_flat_params
from fastapi.params import Query
from fastapi.routing import APIRoute

from specimap_service.errors import RequestInvalidError
from specimap_service.uploads.tus_routes import NOT_SERVED

OPEN = ("sso.get_callback",)
"""Operations to which another program sends a browser, with parameters of its own."""


async def check_query(request: Request) -> None:
    """Check the names in the query: a dependency of all operations, ``async`` so that it takes no thread.

    Raises:
        RequestInvalidError: one is not known, is given twice where one value counts, or holds NUL.
    """
    route = request.scope.get("route")
    if not request.query_params or not isinstance(route, APIRoute):
        return
    known, open = known_parameters(route), route.operation_id in OPEN
    given = [name for name, _ in request.query_params.multi_items()]
    unreadable = {name for name, value in request.query_params.multi_items() if "\0" in value}
    fields = [
        *(
            {"where": f"query.{name[:100]}", "what": "not known here"}
            for name in given
            if name not in known and not open
        ),
        *(
            {"where": f"query.{name}", "what": "given more than once"}
            for name, several in known.items()
            if given.count(name) > 1 and not several
        ),
        *({"where": f"query.{name}", "what": "holds the character NUL"} for name in known if name in unreadable),
    ]
    if fields:
        raise RequestInvalidError(
            f"{fields[0]['where']}: {fields[0]['what']}.",
            advice=f"Parameters here: {', '.join(known)}." if known else "This operation takes no query parameters.",
            fields=fields[:20],
            known=list(known),
        )


def known_parameters(route: APIRoute) -> dict[str, bool]:
    """Return the query parameters of an operation, and whether each may be given several times."""
    found = [field for field in get_flat_params(route.dependant) if isinstance(field.field_info, Query)]
    hidden = {name for method in route.methods or () for name in NOT_SERVED.get(method, ())}
    return {field.alias: _is_list(field.field_info.annotation) for field in found if field.alias not in hidden}


def _is_list(annotation: Any) -> bool:
    return get_origin(annotation) is list or any(map(_is_list, get_args(annotation)))
