"""Values of points as pictures: seen as the cube saw them, and from straight above."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Singles
from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.top_view import extent_mm, top_view

MOST_PX = 900
"""Longer side of a map: a picture across the page has no more pixels to show it with."""
_FITTED_POINTS = 20_000
_CELL_SPACINGS = 1.45
"""Cell of the top view over the distance of neighbouring points: a little above the square's diagonal, so that no cell
of a flat surface stays empty however the cube was turned."""


@dataclass(frozen=True, eq=False)
class CubeFrame:
    """The cube's pixels, ``step`` x ``step`` of which make one of the map; ``mm_per_px`` of the map's pixels."""

    rows: int
    cols: int
    step: int
    mm_per_px: float
    _cell: NDArray[np.int64]

    def mean(self, values: Array, points: Array | None = None) -> Singles:
        """Map (rows, cols) of the mean of ``values`` (S,), or of those (n,) of ``points``; NaN where there is none."""
        cell = self._cell if points is None else self._cell[points]
        finite = np.isfinite(values)
        cell, kept = cell[finite], values[finite]
        size = self.rows * self.cols
        count = np.bincount(cell, minlength=size)
        total = np.bincount(cell, weights=kept, minlength=size)
        mean = np.full(size, np.nan, np.float32)
        np.divide(total, count, out=mean, where=count > 0, casting="unsafe")
        return mean.reshape(self.rows, self.cols)

    def highest(self, classes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Map (rows, cols) of the highest class (S,) in each pixel; 0 where there is no point."""
        found = np.zeros(self.rows * self.cols, np.uint8)
        for value in np.unique(classes):
            found[self._cell[classes == value]] = value
        return found.reshape(self.rows, self.cols)


def cube_frame(cloud: Cloud, shape: tuple[int, int]) -> CubeFrame:
    """The frame of a cube of ``shape`` rows and columns."""
    pixels = cloud.hsi_pixel
    step = max(1, -(-max(shape) // MOST_PX))
    rows, cols = -(-shape[0] // step), -(-shape[1] // step)
    cell = (pixels[:, 0].astype(np.int64) // step) * cols + pixels[:, 1] // step
    return CubeFrame(rows, cols, step, step * spacing_mm(cloud), cell)


def spacing_mm(cloud: Cloud) -> float:
    """Distance in the marker plane of what neighbouring pixels of the cube show, mm; NaN with too few points."""
    low = np.flatnonzero((cloud.flags & Flag.SPECIMEN) == 0)
    points = low if len(low) >= 3 else np.arange(cloud.n_points)
    points = points[:: max(1, len(points) // _FITTED_POINTS)]
    pixels, places = cloud.hsi_pixel[points].astype(float), cloud.xyz[points, :2].astype(float)
    finite = np.isfinite(places).all(1)
    if finite.sum() < 3:
        return float("nan")
    design = np.c_[pixels[finite], np.ones(int(finite.sum()))]
    fitted, *_ = np.linalg.lstsq(design, places[finite], rcond=None)
    found = float(np.sqrt(abs(np.linalg.det(fitted[:2]))))
    return found if found > 0 else float("nan")


@dataclass(frozen=True, eq=False)
class TopRaster:
    """The topmost surface on a grid, y up: ``height_mm`` (rows, cols), ``rgb`` (rows, cols, 3); and where it lies:
    ``extent_mm`` left, right, bottom, top."""

    height_mm: Singles
    rgb: NDArray[np.uint8]
    extent_mm: tuple[float, float, float, float]
    grid_mm: float


def top_raster(cloud: Cloud) -> TopRaster:
    """The cloud from straight above, in the marker frame; NaN and white where there is nothing."""
    x_min, y_min, x_max, y_max = extent_mm(cloud)
    spacing = spacing_mm(cloud)
    least = max(x_max - x_min, y_max - y_min, 1e-3) / (MOST_PX - 1)
    grid = max(least, _CELL_SPACINGS * spacing) if np.isfinite(spacing) else least
    view = top_view(cloud, grid)
    cell, size = view.cell[view.top], view.rows * view.cols
    count = np.bincount(cell, minlength=size)
    there = count > 0
    height = np.full(size, np.nan, np.float32)
    height[there] = np.bincount(cell, weights=cloud.xyz[view.top, 2], minlength=size)[there] / count[there]
    rgb = np.full((size, 3), 255, np.uint8)
    for i in range(3):
        total = np.bincount(cell, weights=cloud.rgb[view.top, i], minlength=size)
        rgb[there, i] = np.rint(total[there] / count[there])
    half = grid / 2
    bounds = (x_min - half, x_min + (view.cols - 0.5) * grid, y_min - half, y_min + (view.rows - 0.5) * grid)
    shape = view.rows, view.cols
    return TopRaster(height.reshape(shape), rgb.reshape(*shape, 3), bounds, grid)
