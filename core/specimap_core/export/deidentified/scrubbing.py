"""Texts in JSON documents: those of known meaning stay, photos get their new names, all others go."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

KEPT = frozenset(
    {
        *("adjustment", "backend", "code", "data_type", "dictionary", "features", "frame", "kind", "length"),
        *(
            "markers_found_in",
            "method",
            "quantity",
            "specimap_version",
            "stage",
            "unit",
            "units",
            "wavelength",
        ),
    }
)
"""Names of values that the program chooses from a list of its own."""
WORD = re.compile(r"^(DICT_)?[a-z0-9_.+*/-]{1,40}$")
NAME = re.compile(r"^[A-Za-z0-9_]{1,48}$")
DROPPED = frozenset({"inputs", "hashes", "settings", "created", "notes", "labels"})
"""Members that go whole: hashes tie a result to its files."""


def scrubbed(value: Any, photos: Mapping[str, str], name: str = "") -> Any:
    """Return a JSON value without texts that are not known to be harmless; ``name``: of the member that it is of.

    Numbers, truth values and the structure stay; members with strange names go.
    """
    if isinstance(value, str):
        if value in photos:
            return photos[value]
        return value if name in KEPT and WORD.match(value) else None
    if isinstance(value, list):
        return [scrubbed(item, photos, name) for item in value]
    if isinstance(value, dict):
        found = {}
        for key, item in value.items():
            if key in DROPPED:
                continue
            if key in photos:
                found[photos[key]] = scrubbed(item, photos, key)
            elif NAME.match(key):
                found[key] = scrubbed(item, photos, key)
        return found
    return value
