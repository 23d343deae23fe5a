"""Stage 3: orthographic grids of the mesh, seen straight down in the marker frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.errors import SettingsError
from specimap_core.surface.raycast import RayCaster

LARGEST_GRID_CELLS = 25_000_000


@dataclass(frozen=True)
class Grid:
    """A top view. Row-major; the centre of cell (0, 0) lies at (``x_min``, ``y_min``) mm, rows grow with y.

    ``image`` (H, W, 3) sRGB uint8; ``xyz`` (H, W, 3) mm and ``normal`` (H, W, 3), NaN where ``covered`` (H, W)
    is false. Grids of different resolution share the origin: their pixels map by exactly diag(s, s, 1).
    """

    cell_mm: float
    x_min: float
    y_min: float
    image: NDArray[np.uint8]
    xyz: NDArray[np.float32]
    normal: NDArray[np.float32]
    covered: NDArray[np.bool_]

    def pixel_of(self, xy: Floats) -> Floats:
        """Positions (..., 2) mm to grid pixels (..., 2) as x, y."""
        return np.asarray((xy - np.array([self.x_min, self.y_min])) / self.cell_mm)


def extent_of(corners: Floats, margin_mm: float) -> tuple[Floats, Floats]:
    """Low and high (2,) mm of the area that the markers' corners (..., 3) span, with a margin."""
    xy = corners.reshape(-1, 3)[:, :2]
    return xy.min(0) - margin_mm, xy.max(0) + margin_mm


def render_grid(caster: RayCaster, low: Floats, high: Floats, cell_mm: float) -> Grid:
    """Cast a ray straight down through each cell's centre over ``low`` to ``high`` (2,) mm.

    Raises:
        SettingsError: the cell is not positive, or so small that the grid would not fit in memory.
    """
    if not cell_mm > 0:
        raise SettingsError(
            f"A grid cell of {cell_mm} mm is not possible.", advice="Give a size above 0.", setting="r_pc"
        )
    width, height = (int(np.ceil((h - l) / cell_mm)) + 1 for l, h in zip(low, high, strict=True))
    if width * height > LARGEST_GRID_CELLS:
        raise SettingsError(
            f"A cell of {cell_mm} mm makes a grid of {width} x {height}.",
            advice="Choose a larger cell.",
            setting="r_pc",
        )
    top = float(caster.mesh.vertices[:, 2].max()) + 1.0
    x = low[0] + cell_mm * np.arange(width)
    image = np.zeros((height, width, 3), np.uint8)
    xyz = np.full((height, width, 3), np.nan, np.float32)
    normal = np.full((height, width, 3), np.nan, np.float32)
    covered = np.zeros((height, width), bool)
    down = np.array([0.0, 0.0, -1.0])
    rows_at_once = max(1, (1 << 19) // width)
    for start in range(0, height, rows_at_once):
        rows = np.arange(start, min(start + rows_at_once, height))
        xs, ys = np.meshgrid(x, low[1] + cell_mm * rows)
        origins = np.stack([xs.ravel(), ys.ravel(), np.full(xs.size, top)], -1)
        hits = caster.cast(origins, np.broadcast_to(down, origins.shape))
        part, shape = slice(start, start + len(rows)), xs.shape
        image[part] = caster.colours(hits).reshape(*shape, 3)
        xyz[part] = hits.xyz.reshape(*shape, 3)
        normal[part] = caster.normals(hits).reshape(*shape, 3)
        covered[part] = hits.hit.reshape(shape)
    return Grid(cell_mm, float(low[0]), float(low[1]), image, xyz, normal, covered)
