"""Headers of answers that no single route sends, in the API's description."""

from __future__ import annotations

from typing import Any

RATE = {
    "RateLimit": {
        "description": 'Requests left to the key, and the seconds until it has all of them again: `"key";r=599;t=1`.',
        "schema": {"type": "string"},
    },
    "RateLimit-Policy": {
        "description": 'Requests that the key may make in a window of so many seconds: `"key";q=600;w=60`.',
        "schema": {"type": "string"},
    },
}
LINK = {
    "Link": {
        "description": 'Address of the next page, with `rel="next"`, where `limit` was given and there is one.',
        "schema": {"type": "string"},
    }
}


def describe_headers(operation: dict[str, Any]) -> None:
    """Say which headers the answers to an operation have."""
    limits = [p["schema"] for p in operation.get("parameters", ()) if p["name"] == "limit"]
    for status, answer in operation["responses"].items():
        if status.startswith("2"):
            found = dict(answer.get("headers", {}))
            if operation.get("security"):
                found |= RATE
            if any("anyOf" in schema for schema in limits):
                found |= LINK
            answer["headers"] = found
