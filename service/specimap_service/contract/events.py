"""The types of the events that a job's stream sends, in the API's description."""

from __future__ import annotations

from typing import Any

from specimap_service.jobs.schemas import EVENT_TYPES

STREAM = "text/event-stream"


def describe_events(operation: dict[str, Any]) -> None:
    """Say of each event of a stream what it holds.

    ``x-item-schema`` is what OpenAPI 3.2 calls ``itemSchema``; 3.1 has no name for it.
    """
    for answer in operation["responses"].values():
        stream = answer.get("content", {}).get(STREAM)
        if stream is not None:
            stream["x-item-schema"] = {"oneOf": [_event(name, model.__name__) for name, model in EVENT_TYPES.items()]}


def _event(name: str, model: str) -> dict[str, Any]:
    return {
        "type": "object",
        "required": ["id", "event", "data"],
        "properties": {
            "id": {"type": "string", "pattern": r"^\d+$", "description": "Counts from 1; send it as Last-Event-ID."},
            "event": {"const": name},
            "data": {
                "type": "string",
                "contentMediaType": "application/json",
                "contentSchema": {"$ref": f"#/components/schemas/{model}"},
            },
        },
    }
