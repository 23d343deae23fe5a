"""``python -m specimap_infra.settings_table``: print the tables of docs/settings.md, made from the settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import SecretStr
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES
from specimap_infra.settings import GIB, MIB, ServiceSettings

DATA_DIR = "`$XDG_DATA_HOME/specimap`, else `~/.local/share/specimap`"
HEADER = "| variable | default | takes | meaning |\n|---|---|---|---|"
OF_BACKENDS = (
    "Backends and devices, for `specimap worker`, `serve` and `run`. These come from the environment only, never from "
    "the file.\n[backends.md](backends.md) gives their defaults and their possible values."
)


def settings_table() -> str:
    """All settings as a Markdown table, one per line, in the order of the class."""
    return "\n".join([HEADER, *(_row(name, field) for name, field in ServiceSettings.model_fields.items())])


def backends_table() -> str:
    """The variables of backends and devices as a Markdown table, one per line."""
    rows = (f"| `{name}` | {meaning} |" for name, meaning in BACKEND_VARIABLES.items())
    return "\n".join(["| variable | meaning |\n|---|---|", *rows])


def page_part() -> str:
    """Both tables, as docs/settings.md holds them."""
    return f"{settings_table()}\n\n{OF_BACKENDS}\n\n{backends_table()}"


FILES = ("_ca", "_certificate", "_key", "_file")
"""Endings of the names of settings that name a file."""


def _row(name: str, field: FieldInfo) -> str:
    cells = (f"`SPECIMAP_{name.upper()}`", _default(name, field), _takes(name, field), field.description or "")
    # A bar would end the cell, even within a code span.
    return "| " + " | ".join(cell.replace("|", r"\|") for cell in cells) + " |"


def _default(name: str, field: FieldInfo) -> str:
    if name == "data_dir":
        return DATA_DIR  # the one default that differs from user to user
    value = field.get_default(call_default_factory=True, validated_data={})
    if value is PydanticUndefined:
        raise TypeError(f"{name} has no default")
    if value in ("", None, {}) or (isinstance(value, SecretStr) and not value.get_secret_value()):
        return ""
    if isinstance(value, bool):
        return str(value).lower()
    if name.endswith("_bytes"):
        for unit, size in (("GiB", GIB), ("MiB", MIB)):
            if value and value % size == 0:
                return f"{value} ({value // size} {unit})"
    return (
        f"`{value}`"
        if isinstance(value, str | list | dict)
        else f"{value:g}"
        if isinstance(value, float)
        else str(value)
    )


def _takes(name: str, field: FieldInfo) -> str:
    kind: Any = field.annotation
    if get_origin(kind) is Literal:
        return ", ".join(f"`{choice}`" for choice in get_args(kind))
    if kind in (Path, Path | None):
        return "a file" if name.endswith(FILES) else "a folder"
    if kind in (list[str], list[SecretStr]):
        return "a JSON list of text"
    if kind == dict[str, float]:
        return "a JSON object of numbers"
    if kind == dict[str, str]:
        return "a JSON object of text"
    if kind is bool:
        return "`true` or `false`"
    if kind in (str, SecretStr):
        return "text" if kind is str else "text, a secret"
    noun = {int: "whole number", float: "number"}[kind]
    limits = [f"{word} {value}" for word, value in _limits(field)]
    return ", ".join([noun, *limits])


def _limits(field: FieldInfo) -> list[tuple[str, object]]:
    words = {"ge": "at least", "gt": "above", "le": "at most"}
    return [(words[word], getattr(rule, word)) for rule in field.metadata for word in words if hasattr(rule, word)]


if __name__ == "__main__":
    print(page_part())
