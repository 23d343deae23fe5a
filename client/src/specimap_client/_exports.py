"""Files made from a result on request: asked for, waited for, downloaded."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from specimap_client import _retries
from specimap_client._downloads import fetch
from specimap_client._errors import ExportFailed, Timeout
from specimap_client._http import Session, path
from specimap_client._models import Export, Progress

Format = Literal[
    "mesh-ply",
    "mesh-stl",
    "mesh-obj",
    "mesh-glb",
    "ply",
    "las",
    "npz",
    "envi",
    "zarr",
    "csv",
    "html",
    "pdf",
    "deidentified",
    "deidentified-inputs",
]
_PAUSES = (0.1, 0.25, 0.5, 1.0, 2.0)


def request(session: Session, cloud: str, format: str) -> Export:
    """Ask for an export; one that is there or under way is answered with."""
    return Export.of(session.json("POST", path("clouds", cloud, "exports", format), safe=True))


def wait(session: Session, export: Export, timeout: float | None) -> Export:
    """Wait until it is ready.

    Raises:
        ExportFailed: it ended without a file.
        Timeout: it has not ended in ``timeout`` seconds.
    """
    deadline = None if timeout is None else time.monotonic() + timeout
    attempt = 0
    while not export.final:
        if deadline is not None and time.monotonic() >= deadline:
            raise Timeout(f"The export {export.format} of {export.cloud_id} is not ready in the time given.")
        _retries.sleep(_PAUSES[min(attempt, len(_PAUSES) - 1)])
        attempt += 1
        export = Export.of(session.json("GET", path("clouds", export.cloud_id, "exports", export.format)))
    if export.state != "succeeded":
        raise ExportFailed(export)
    return export


def download(session: Session, export: Export, target: Path, progress: Callable[[Progress], None] | None) -> Path:
    """Write its file to ``target``, resumed where the connection breaks."""

    def heard(have: int, total: int) -> None:
        if progress is not None:
            progress(Progress(target.name, have, total, have, total))

    return fetch(session, path("clouds", export.cloud_id, "exports", export.format, "content"), target, heard)
