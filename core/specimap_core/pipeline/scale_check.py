"""Whether the marker's edge and the grids fit what was photographed, asked before any depth is measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import EdgeImplausibleError, SettingsError
from specimap_core.geometry.cameras import Pose
from specimap_core.pipeline.options import OPTIONS, OTHER_UNITS
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.render.orthographic import LARGEST_GRID_CELLS

PLAUSIBLE_DISTANCE_MM = (50.0, 1200.0)
"""A phone does not focus nearer; and nobody photographs a specimen between markers from farther."""
POSSIBLE_DISTANCE_MM = (25.0, 3000.0)
"""Beyond these the edge is wrong whatever the camera: a macro lens needs about 20 mm to the specimen."""
USUAL_DISTANCE_MM = (80.0, 800.0)
SUBJECT_DISAGREES = 2.0
"""Ratio of EXIF's distance to the markers' from which one of them is doubted."""
SUBJECT_CONTRADICTS = 5.0
"""Ratio from which an edge that is implausible by itself, too, is refused."""
LEAST_CELLS = 8
"""Of a grid across the layout: with fewer, no registration is possible on it."""


def reach_mm(poses: Sequence[Pose], corners: Floats) -> float:
    """Median distance of the cameras to the middle of the markers (Q, 4, 3)."""
    middle = corners.reshape(-1, 3).mean(0)
    return float(np.median([np.linalg.norm(p.centre - middle) for p in poses]))


def check_scale(
    poses: Sequence[Pose], corners: Floats, settings: PipelineSettings, subject_mm: float | None = None
) -> None:
    """Refuse an edge, or a grid's cell, that cannot be: poses and corners (Q, 4, 3) are in mm by that edge.

    Raises:
        EdgeImplausibleError: the photos would have been taken from where no camera focuses, or far from any specimen;
            details hold the distance.
        SettingsError: a grid would have too few cells, or more than memory holds.
    """
    _check_edge(reach_mm(poses, corners), settings.adjust.edge_mm, subject_mm)
    width, height = np.ptp(corners.reshape(-1, 3), axis=0)[:2]
    for name, cell in (("r_pc", settings.render.r_pc_mm), ("r_reg", settings.render.r_reg_mm)):
        # A single marker spans nothing; the fault is reported then where the cube's markers are counted.
        coarse = len(corners) > 1 and max(width, height) < LEAST_CELLS * cell
        if coarse or width * height > LARGEST_GRID_CELLS * cell**2:
            finest = max(OPTIONS[name].bounds[0], float(np.sqrt(width * height / LARGEST_GRID_CELLS)))
            raise SettingsError(
                f"{name} is {cell:g} mm, and the markers span {width:.0f} x {height:.0f} mm.",
                advice=f"Give {name} from {finest:.2g} to {max(width, height) / LEAST_CELLS:.2g} mm.",
                setting=name,
            )


def _check_edge(reach: float, edge_mm: float, subject_mm: float | None) -> None:
    low, high = POSSIBLE_DISTANCE_MM
    plausible = PLAUSIBLE_DISTANCE_MM[0] < reach < PLAUSIBLE_DISTANCE_MM[1]
    contradicted = bool(subject_mm) and not plausible and disagrees(reach, subject_mm, SUBJECT_CONTRADICTS)
    if low < reach < high and not contradicted:
        return
    beside = f", and EXIF says {subject_mm:.0f} mm" if contradicted else ""
    raise EdgeImplausibleError(
        f"With a marker edge of {edge_mm:g} mm the photos were taken from {_length(reach)}{beside}: the edge is wrong.",
        advice=f"Measure the black edge of a printed marker and give it in millimetres{likely_unit(edge_mm, reach)}.",
        edge_mm=edge_mm,
        distance_mm=round(reach, 3),
    )


def disagrees(reach: float, subject_mm: float | None, ratio: float = SUBJECT_DISAGREES) -> bool:
    """Whether EXIF states another distance than the markers give."""
    return subject_mm is not None and not 1 / ratio < reach / subject_mm < ratio


def likely_unit(edge_mm: float, reach: float) -> str:
    """The units that would put the photos at a usual distance, as the end of a sentence; '' where none does."""
    fitting = [
        (unit, factor)
        for unit, factor in OTHER_UNITS.items()
        if USUAL_DISTANCE_MM[0] <= reach * factor <= USUAL_DISTANCE_MM[1]
    ]
    if not fitting:
        return ""
    return "; " + ", ".join(f"{edge_mm:g} {unit} are {edge_mm * factor:.4g} mm" for unit, factor in fitting)


def _length(mm: float) -> str:
    return f"{mm / 1000:.1f} m" if mm >= 1000 else f"{mm:.3g} mm"
