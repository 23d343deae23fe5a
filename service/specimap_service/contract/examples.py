"""Examples of answers. A page's and a list's are made from that of their items; the others stand in examples.json."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any


@cache
def recorded() -> dict[str, dict[str, Any]]:
    """Read the examples: ``schemas`` by name, ``answers`` without a schema by operation and media type."""
    found: dict[str, dict[str, Any]] = json.loads(Path(__file__).with_name("examples.json").read_text("utf-8"))
    return found


def add_examples(contract: dict[str, Any]) -> None:
    """Add an example to each schema that answers have, and to answers that have none."""
    schemas, given = contract["components"]["schemas"], recorded()
    for name, example in given["schemas"].items():
        schemas[name].setdefault("example", example)
    for schema in schemas.values():
        item = schema.get("properties", {}).get("items", {}).get("items")
        if "next" in schema.get("properties", {}) and item is not None:
            schema["example"] = {"items": [_of(item, schemas)], "next": None}
    for methods in contract["paths"].values():
        for operation in methods.values():
            own = given["answers"].get(operation["operationId"], {})
            for status, answer in operation["responses"].items():
                if status.startswith("2"):
                    for media, content in answer.get("content", {}).items():
                        if media in own:
                            content["example"] = own[media]
                        elif content.get("schema", {}).get("type") == "array":
                            content["example"] = [_of(content["schema"]["items"], schemas)]


def _of(item: dict[str, Any], schemas: dict[str, Any]) -> Any:
    return schemas[item["$ref"].rpartition("/")[2]]["example"]
