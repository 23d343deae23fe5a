"""A cloud seen from above: which points are the topmost surface in each cell of a regular grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.cloud import Cloud
from specimap_core.errors import SettingsError

TOP_DEPTH_MM = 1.0
"""Points this far below the highest of their cell still belong to the surface seen from above."""
_MOST_CELLS = 50_000_000


@dataclass(frozen=True, eq=False)
class TopView:
    """Cells (rows, cols) of ``grid_mm``; cell (0, 0)'s centre at (x_min, y_min), rows grow with y.

    ``cell`` (S,): each point's cell, row-major; ``top`` (S,): whether it is seen from above.
    """

    grid_mm: float
    x_min: float
    y_min: float
    rows: int
    cols: int
    cell: NDArray[np.int32]
    top: NDArray[np.bool_]


def extent_mm(cloud: Cloud) -> tuple[float, float, float, float]:
    """x_min, y_min, x_max, y_max of the cloud, mm."""
    boxes = cloud.chunk_aabb
    low, high = boxes[:, :2].min(0), boxes[:, 3:5].max(0)
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])


def top_view(cloud: Cloud, grid_mm: float) -> TopView:
    """The cloud's points on a grid. Raises SettingsError for a grid that is not positive or far too fine."""
    x_min, y_min, x_max, y_max = extent_mm(cloud)
    if not (np.isfinite(grid_mm) and grid_mm > 0):
        raise SettingsError(
            f"A grid of {grid_mm} mm is not possible.", advice="Give a positive size.", setting="grid_mm"
        )
    cols, rows = (x_max - x_min) / grid_mm + 1, (y_max - y_min) / grid_mm + 1
    if cols * rows > _MOST_CELLS:
        least = float(np.sqrt((x_max - x_min) * (y_max - y_min) / _MOST_CELLS))
        raise SettingsError(
            f"A grid of {grid_mm} mm would have {cols * rows:.3g} cells.",
            advice=f"Choose a cell of at least {max(least, grid_mm) * 1.1:.2g} mm.",
            setting="grid_mm",
        )
    col = np.rint((cloud.xyz[:, 0] - np.float32(x_min)) / np.float32(grid_mm)).astype(np.int32)
    row = np.rint((cloud.xyz[:, 1] - np.float32(y_min)) / np.float32(grid_mm)).astype(np.int32)
    n_rows, n_cols = int(row.max()) + 1, int(col.max()) + 1
    cell = row * np.int32(n_cols) + col
    z = cloud.xyz[:, 2]
    highest = np.full(n_rows * n_cols, -np.inf, np.float32)
    np.maximum.at(highest, cell, z)
    top = z >= highest[cell] - np.float32(TOP_DEPTH_MM)
    return TopView(grid_mm, x_min, y_min, n_rows, n_cols, cell, top)
