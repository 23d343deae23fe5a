"""The grid that all pictures of a result share: straight from above, in the marker frame, with every marker on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats, Singles
from specimap_core.cloud import Cloud
from specimap_core.cloud.preview import nearest_covered, preview_grid_mm, view_picture
from specimap_core.cloud.top_view import TopView, top_view
from specimap_core.errors import CloudDamagedError

MARGIN_MM = 1.0
"""Around the outermost corner."""
MOST_AROUND_MM = 200.0
"""A marker that lies farther off than this from the cloud is left outside."""


@dataclass(frozen=True, eq=False)
class Canvas:
    """``rows`` x ``cols`` pixels of ``grid_mm``, row 0 at the top (largest y).

    ``left`` and ``below``: pixels of the canvas left of, and below, the cells of ``view``, in which the cloud lies.
    """

    view: TopView
    left: int
    below: int
    rows: int
    cols: int

    @classmethod
    def of(cls, cloud: Cloud, corners: Floats) -> Canvas:
        """The canvas of a cloud and markers' corners (Q, 4, 3), mm."""
        view = top_view(cloud, preview_grid_mm(cloud))
        grid = view.grid_mm
        low = np.array([view.x_min, view.y_min])
        high = low + grid * np.array([view.cols - 1, view.rows - 1])
        around = corners[..., :2].reshape(-1, 2)
        near = ((around > low - MOST_AROUND_MM) & (around < high + MOST_AROUND_MM)).all(1)
        around = around[near]
        lowest = np.minimum(low, around.min(0) - MARGIN_MM) if len(around) else low
        highest = np.maximum(high, around.max(0) + MARGIN_MM) if len(around) else high
        left, below = (math.ceil((a - b) / grid) for a, b in zip(low, lowest, strict=True))
        right, above = (math.ceil((a - b) / grid) for a, b in zip(highest, high, strict=True))
        return cls(view, left, below, view.rows + below + above, view.cols + left + right)

    @property
    def grid_mm(self) -> float:
        """Edge of a pixel."""
        return self.view.grid_mm

    def pixels(self, xy: Floats) -> Floats:
        """Places (n, 2) mm as columns and rows (n, 2) of the picture, pixel centres at integers."""
        col = (xy[:, 0] - self.view.x_min) / self.grid_mm + self.left
        row = self.rows - 1 - ((xy[:, 1] - self.view.y_min) / self.grid_mm + self.below)
        return np.stack([col, row], 1)

    @property
    def first_pixel_mm(self) -> tuple[float, float]:
        """x, y of the centre of the pixel at the top left."""
        x = self.view.x_min - self.left * self.grid_mm
        return x, self.view.y_min + (self.rows - 1 - self.below) * self.grid_mm

    def rgb(self, cloud: Cloud) -> NDArray[np.uint8]:
        """The photos' colours (rows, cols, 3); black where there is no point."""
        return self.placed(view_picture(self.view, cloud.rgb)[..., :3])

    def preview(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A run's own preview (H, W, 4), which has the view's cells, on the canvas (rows, cols, 3).

        Raises:
            CloudDamagedError: it is of another cloud, or another grid.
        """
        if picture.shape[:2] != (self.view.rows, self.view.cols):
            raise CloudDamagedError(
                "preview.png has not the size of the cloud.", advice="Repeat the run.", array="preview.png"
            )
        return self.placed(picture[..., :3] * (picture[..., 3:] > 0))

    def means(self, values: Array) -> Singles:
        """Mean of the values (S,) of each pixel's topmost points (rows, cols); NaN where there is none."""
        seen = self.view.top & np.isfinite(values)
        cell, size = self.view.cell[seen], self.view.rows * self.view.cols
        count = np.bincount(cell, minlength=size)
        total = np.bincount(cell, weights=values[seen], minlength=size)
        mean = np.full(size, np.nan, np.float32)
        np.divide(total, count, out=mean, where=count > 0, casting="unsafe")
        return self._spread(mean, count > 0, np.float32("nan"))

    def classes(self, values: Array, highest_first: Array) -> NDArray[np.uint16]:
        """The class of each pixel's highest point (rows, cols); 0 where there is none.

        ``highest_first`` (S,): the points' order by falling height.
        """
        cell = self.view.cell[highest_first]
        cells, first = np.unique(cell, return_index=True)
        found = np.zeros(self.view.rows * self.view.cols, np.uint16)
        covered = np.zeros(len(found), bool)
        found[cells], covered[cells] = values[highest_first[first]], True
        return self._spread(found, covered, np.uint16(0))

    @cached_property
    def covered(self) -> NDArray[np.bool_]:
        """Which pixels (rows, cols) show a point, or take the value of one nearby."""
        there = np.zeros(self.view.rows * self.view.cols, bool)
        there[self.view.cell] = True
        source = nearest_covered(there.reshape(self.view.rows, self.view.cols))
        return np.asarray(self.placed((source >= 0)[::-1]), bool)

    def _spread(self, values: Array, covered: NDArray[np.bool_], nothing: np.generic) -> Array:
        """Values of the view's cells, small holes filled, on the canvas."""
        source = nearest_covered(covered.reshape(self.view.rows, self.view.cols))
        return self.placed(np.where(source >= 0, values[source], nothing)[::-1], nothing)

    def placed(self, picture: Array, nothing: np.generic | int = 0) -> Array:
        """A picture of the view's cells, row 0 at the top, on the canvas."""
        whole = np.full((self.rows, self.cols, *picture.shape[2:]), nothing, picture.dtype)
        top = self.rows - self.below - self.view.rows
        whole[top : top + self.view.rows, self.left : self.left + self.view.cols] = picture
        return whole
