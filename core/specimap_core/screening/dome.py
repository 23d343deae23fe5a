"""The dome of directions around a specimen: which are photographed, and where to stand next."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.screening.viewpoints import Viewpoint

RINGS = ((20.0, 45.0, 35.0, 10), (45.0, 65.0, 55.0, 8), (65.0, 90.0, 75.0, 4))
"""Rings of cells as docs/surgeon-imaging.md wants the photos: elevations from, to, and of the middle; number of cells.
Neighbouring middles are 20 to 30 degrees apart."""
REACH_DEG = 18.0
"""A photo covers the cell that it lies in, and those whose middle it is this near to."""
WANTED_PHOTOS = 20
ENOUGH_COVERED = 0.9


@dataclass(frozen=True)
class Cell:
    """A part of the dome; ``gap_deg``: from its middle to the nearest photo, None without any."""

    azimuth_deg: float
    elevation_deg: float
    azimuth_from_deg: float
    azimuth_to_deg: float
    elevation_from_deg: float
    elevation_to_deg: float
    covered: bool
    gap_deg: float | None


@dataclass(frozen=True)
class Dome:
    """``covered``: share of the cells. ``next``: the cell to stand in next, None where all are covered.

    ``enough``: nine of ten cells are covered, by 20 photos or more; or all cells are.
    """

    cells: tuple[Cell, ...]
    covered: float
    next: Cell | None
    enough: bool


def direction(azimuth_deg: float, elevation_deg: float) -> Floats:
    """The unit vector (3,) toward a place in the dome."""
    a, e = np.radians([azimuth_deg, elevation_deg])
    return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])


def dome_of(views: Sequence[Viewpoint]) -> Dome:
    """Lay viewpoints, the newest last, into the dome."""
    photos = np.array([direction(view.azimuth_deg, view.elevation_deg) for view in views]).reshape(-1, 3)
    cells = tuple(
        _cell((low, high, middle), start, 360.0 / count, views, photos)
        for low, high, middle, count in RINGS
        for start in np.arange(count) * (360.0 / count) - 180.0
    )
    covered = sum(cell.covered for cell in cells) / len(cells)
    open_cells = [cell for cell in cells if not cell.covered]
    enough = not open_cells or (covered >= ENOUGH_COVERED and len(views) >= WANTED_PHOTOS)
    return Dome(cells, covered, _next(open_cells, photos), enough)


def _cell(
    ring: tuple[float, float, float], start: float, width: float, views: Sequence[Viewpoint], photos: Floats
) -> Cell:
    low, high, middle = ring
    azimuth = start + width / 2
    gaps = np.degrees(np.arccos(np.clip(photos @ direction(azimuth, middle), -1, 1)))
    inside = any(low <= view.elevation_deg < high and (view.azimuth_deg - start) % 360 < width for view in views)
    gap = float(gaps.min()) if len(views) else None
    covered = inside or (gap is not None and gap <= REACH_DEG)
    return Cell(azimuth, middle, start, start + width, low, high, covered, gap)


def _next(cells: Sequence[Cell], photos: Floats) -> Cell | None:
    """The uncovered cell nearest to the newest photo, so that the way is short; of equally near ones the emptiest.

    The place farthest from all photos would send a person back and forth across the table.
    """
    if not cells:
        return None
    if not len(photos):
        return cells[0]

    def way(cell: Cell) -> tuple[float, float]:
        away = np.degrees(np.arccos(np.clip(photos[-1] @ direction(cell.azimuth_deg, cell.elevation_deg), -1, 1)))
        return round(float(away) / 5), -(cell.gap_deg or 0.0)

    return min(cells, key=way)
