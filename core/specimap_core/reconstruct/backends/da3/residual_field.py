"""Correct a network's aligned depth by a smooth field of its residuals at known places."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.reconstruct.backends.depth_alignment import NEAR

REACH = 0.025
"""Sd of the kernel that spreads what known places show, as a share of the picture's longer side: 2 mm on a specimen."""
DOUBT = 3.0
"""As many places as this that show no error are added everywhere."""


def correct_residuals(depth: Singles, at: Floats, true: Floats) -> tuple[Singles, float]:
    """Aligned depth (H, W) mm drawn to true depths (N,) mm at pixels (N, 2), and the scatter that is left.

    A network's error changes slowly over the picture. Its share of the depth, as the known places show it, is averaged
    over :data:`REACH` of the picture and taken off; where no place is known nothing changes.
    """
    found = map_coordinates(depth, at[:, ::-1].T, order=1, mode="nearest")
    known = found > 0
    column, row = np.rint(at[known]).astype(int).T
    off = true[known] / found[known] - 1
    reach = REACH * max(depth.shape)
    if not len(off):
        return depth.copy(), np.inf
    # A poor network is off by more than what tells false matches from true ones about a good one.
    near = np.abs(off) < max(2 * NEAR, 3 * SIGMA_OF_MAD * float(np.median(np.abs(off))))
    total, count = (np.zeros(depth.shape) for _ in range(2))
    np.add.at(total, (row[near], column[near]), off[near])
    np.add.at(count, (row[near], column[near]), 1.0)
    # Times the kernel's area, the smoothed count is the number of places within reach.
    area = 2 * np.pi * reach**2
    total, count = (area * gaussian_filter(v, reach, mode="constant") for v in (total, count))
    field = total / (count + DOUBT)
    scatter = SIGMA_OF_MAD * float(np.median(np.abs(off - field[row, column])[near]))
    return (depth * (1 + field)).astype(np.float32), scatter
