"""JSON as it leaves the program: JSON has no NaN and no infinity, so what is not finite is written as null."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np


def json_ready(value: object) -> Any:
    """``value`` with numpy's numbers and arrays, tuples, sets and paths as JSON's; what is not finite as null, what
    JSON does not know as text, and half characters by their codes."""
    if isinstance(value, str):
        # Half characters stand for bytes of a path that are no UTF-8; JSON has none.
        return value if value.isascii() else value.encode("utf-8", "backslashreplace").decode()
    if value is None or isinstance(value, bool | int):
        return value
    if isinstance(value, float):
        # float: numpy's double is one by class, but not for every encoder.
        return float(value) if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {json_ready(str(key)): json_ready(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return json_ready(value.tolist())
    if isinstance(value, list | tuple | set | frozenset):
        return [json_ready(item) for item in value]
    return json_ready(str(value))


def json_text(
    value: object,
    *,
    indent: int | None = None,
    sort_keys: bool = False,
    separators: tuple[str, str] | None = None,
    ensure_ascii: bool = True,
) -> str:
    """``value`` as JSON that every parser reads; see :func:`json_ready`."""
    return json.dumps(
        json_ready(value),
        allow_nan=False,
        indent=indent,
        sort_keys=sort_keys,
        separators=separators,
        ensure_ascii=ensure_ascii,
    )


def json_log_line(event: Mapping[str, Any], **_: object) -> str:
    """For a logger that brings its own encoder's options."""
    return json_text(event)
