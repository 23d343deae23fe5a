"""The document at ``/openapi.json``: FastAPI's, completed from the routes themselves."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

from fastapi import FastAPI
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute, RouteContext, iter_route_contexts
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from specimap_service.auth.dependencies import known_principal, permission_of, permitted
from specimap_service.auth.permissions import roles_for, scope_for
from specimap_service.contract.events import describe_events
from specimap_service.contract.examples import add_examples
from specimap_service.contract.headers import describe_headers
from specimap_service.contract.refusals import Refusals
from specimap_service.uploads.tus import PREFIX
from specimap_service.uploads.tus_routes import NEEDED, NOT_SERVED

SCHEMAS = "#/components/schemas/"
HTTP_HEADERS = ("content-length", "content-type")
"""Headers of HTTP itself: the server answers wrong ones before the app sees them."""
METHODS = ("get", "put", "post", "delete", "options", "head", "patch")


def describe(app: FastAPI, extra_models: Sequence[type[BaseModel]] = ()) -> None:
    """Complete the app's description.

    ``extra_models``: models of bodies that routes read themselves and only refer to.
    """
    original = app.openapi
    made: dict[str, Any] = {}

    def openapi() -> dict[str, Any]:
        if not made:
            contract = original()
            _add_schemas(contract, extra_models)
            _complete(app, contract)
            made.update(_renamed(contract))
            add_examples(made)
        return made

    app.openapi = openapi  # type: ignore[method-assign]


def operations(contract: dict[str, Any]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """List the operations with their methods, in small letters, and addresses."""
    for path, methods in contract["paths"].items():
        for method in METHODS:
            if method in methods:
                yield method, path, methods[method]


def _add_schemas(contract: dict[str, Any], models: Sequence[type[BaseModel]]) -> None:
    _, extra = models_json_schema([(model, "validation") for model in models], ref_template=SCHEMAS + "{model}")
    contract["components"]["schemas"] |= extra.get("$defs", {})


def _complete(app: FastAPI, contract: dict[str, Any]) -> None:
    routes = {
        (method.lower(), route.path_format): route
        for route in iter_route_contexts(app.routes)
        if isinstance(route.original_route, APIRoute)
        for method in route.methods or ()
    }
    refusals = Refusals(contract)
    for method, path, operation in operations(contract):
        route = routes[method, path]
        hidden = {*HTTP_HEADERS, *(NOT_SERVED.get(method.upper(), ()) if path.startswith(PREFIX) else ())}
        given = operation.get("parameters", [])
        operation["parameters"] = [p for p in given if p["name"].lower() not in hidden]
        for parameter in operation["parameters"]:
            if parameter["in"] == "header" and parameter["name"] in NEEDED:
                # The library reads them as if they were optional; without them it refuses.
                parameter |= {"required": True, "schema": NEEDED[parameter["name"]]}
        if route.summary is None:
            operation["summary"] = re.split(r"[.:;] ", operation["description"].strip().rstrip(".") + ". ")[0]
        permission = checked_permission(route, operation["operationId"])
        if permission is not None:
            scope = scope_for(permission)
            # OpenAPI 3.1 lets every kind of scheme name what it needs here, not only OAuth 2.
            operation["security"] = [{name: [scope] for name in need} for need in operation["security"]]
            operation["x-permission"] = permission
            roles = ", ".join(f"`{role}`" for role in roles_for(permission))
            note = f"Permission: `{permission}`, of keys with the scope `{scope}`, and of the roles {roles}."
            operation["description"] = f"{operation.get('description', '')}\n\n{note}".strip()
        describe_headers(operation)
        refusals.add(method, path, operation)
        describe_events(operation)


def checked_permission(route: RouteContext, operation: str) -> str | None:
    """Return the permission that an operation asks for; None where every key will do, or none is needed.

    Raises:
        ValueError: its route takes a key and does not ask whether that has the permission.
    """
    calls = set(_calls(route.dependant))
    if known_principal not in calls:
        return None
    permission = permission_of(operation)
    if permission is not None and permitted not in calls:
        raise ValueError(f"{route.path} does not check {permission}: declare its principal as Permitted")
    return permission


def _calls(dependant: Dependant) -> Iterator[Any]:
    for inner in dependant.dependencies:
        yield inner.call
        yield from _calls(inner)


def _renamed(contract: dict[str, Any]) -> dict[str, Any]:
    """Give schemas the names in their titles, which a model may choose: ``Job`` for ``JobView``."""
    schemas = contract["components"]["schemas"]
    names = {name: schema.get("title", name) for name, schema in schemas.items()}
    if len(set(names.values())) < len(names):
        raise ValueError("two schemas have the same title")
    contract["components"]["schemas"] = dict(sorted((names[name], schema) for name, schema in schemas.items()))
    changed = {SCHEMAS + old: SCHEMAS + new for old, new in names.items() if old != new}

    def walk(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: changed.get(part, part) if key == "$ref" else walk(part) for key, part in value.items()}
        if isinstance(value, list):
            return [walk(item) for item in value]
        return changed.get(value, value) if isinstance(value, str) else value

    renamed: dict[str, Any] = walk(contract)
    return renamed
