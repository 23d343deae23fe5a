"""Label layers in the encodings that clients send."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.support.result_scene import Result

ARROW, NPY = "application/vnd.apache.arrow.stream", "application/x-npy"


CLASSES: list[dict[str, Any]] = [
    {"value": 0, "name": "unlabelled"},
    {"value": 1, "name": "tumour", "colour": "#d62728"},
    {"value": 700, "name": "healthy", "colour": "#2ca02c"},
]


MODEL = {"name": "net-3d", "version": "1.4", "kind": "model", "sha256": "abc"}


def npy(values: NDArray[Any]) -> bytes:
    out = io.BytesIO()
    np.save(out, values)
    return out.getvalue()


def header(kind: str = "class", classes: list[dict[str, Any]] | None = None, **more: Any) -> dict[str, str]:
    described = {"kind": kind, "classes": CLASSES if classes is None else classes, "made_by": MODEL, **more}
    return {"X-Specimap-Label": json.dumps(described), "Content-Type": NPY}


def layer(result: Result, name: str = "tissue") -> str:
    return f"/v1/clouds/{result.cloud_id}/labels/{name}"
