"""A result's files, read and checked."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.cloud import Cloud
from specimap_core.errors import CloudDamagedError, NotFoundError
from specimap_core.report.model import Report, read_report
from specimap_hospital.dicom.canvas import Canvas

NEEDED = ("corners.json", "mesh.ply", "preview.png")


@dataclass(frozen=True, eq=False)
class Result:
    """An open result. ``corners`` (Q, 4, 3) mm in the marker frame, of ``marker_ids``."""

    folder: Path
    report: Report
    cloud: Cloud
    marker_ids: tuple[int, ...]
    corners: Floats

    @cached_property
    def canvas(self) -> Canvas:
        """The grid of its pictures."""
        return Canvas.of(self.cloud, self.corners)


def open_result(folder: Path) -> Result:
    """Open the result in ``folder``.

    Raises:
        NotFoundError: a file is missing, or the report is of a version that this one cannot read.
        CloudDamagedError: the cloud or the corners do not read.
    """
    report, cloud = read_report(folder), Cloud.open(folder / "cloud.zarr")
    for name in NEEDED:
        if not (folder / name).is_file():
            raise NotFoundError(f"The result holds no {name}.", advice="Name the folder of a finished run.")
    ids, corners = read_corners(folder / "corners.json")
    return Result(folder, report, cloud, ids, corners)


def read_corners(path: Path) -> tuple[tuple[int, ...], Floats]:
    """Ids and corners (Q, 4, 3) mm, marker frame, of a run's markers.

    Raises:
        CloudDamagedError: it is no such file.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        ids = tuple(int(marker) for marker in stored)
        corners = np.array(list(stored.values()), float)
        if not ids or corners.shape != (len(ids), 4, 3) or not np.isfinite(corners).all():
            raise ValueError("the corners have another shape")
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise CloudDamagedError(
            "corners.json does not hold the corners of markers.", advice="Repeat the run.", array="corners.json"
        ) from error
    return ids, corners
