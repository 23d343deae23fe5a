"""The reader's own process: answers one request, and ends. Its answer says nothing of what it could not read."""

from __future__ import annotations

import json
import os
import resource
import sys
from pathlib import Path
from typing import Any

from specimap_core.json_text import json_text
from specimap_core.sandbox.lifetime import die_with
from specimap_core.threads import limit_blas_threads
from specimap_hospital.receive.classes import CANNOT_UNDERSTAND

CPU_SECONDS = 120


def answer(request: dict[str, Any]) -> dict[str, Any]:
    """Read an object, or put labels onto points."""
    # Imported late, since they load the DICOM libraries.
    import numpy as np

    from specimap_core.cloud import Cloud
    from specimap_hospital.receive.reading import on_points, read

    out = Path(request["out"])
    if request["task"] == "read":
        return read(Path(request["path"]), out / request["name"])
    folder = Path(request["folder"])
    corners = json.loads((folder / "corners.json").read_text("utf-8"))
    values = on_points(
        Cloud.open(folder / "cloud.zarr"),
        np.array(list(corners.values()), float).reshape(-1, 4, 3),
        np.load(request["path"], allow_pickle=False),
        request["place"],
    )
    np.save(out / "points.npy", values)
    return {"points": len(values), "labelled": int(np.count_nonzero(values))}


def main(arguments: list[str]) -> int:
    """Arguments: the parent's process id, most bytes of memory (0: no limit)."""
    limit_blas_threads()
    parent, memory = arguments
    die_with(int(parent))
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_SECONDS, CPU_SECONDS))
    if int(memory):
        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    # Libraries that print would spoil the answer, or tell of patients.
    said = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    silent = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silent, 1)
    os.dup2(silent, 2)
    try:
        found = answer(json.loads(sys.stdin.readline()))
    except Exception as error:
        found = {"failure": getattr(error, "failure", CANNOT_UNDERSTAND)}
    said.write(json_text(found) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
