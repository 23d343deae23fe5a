"""The box over the markers in which a surface is looked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.cameras import Intrinsics, Pose

LATTICE = (13, 13, 5)
"""Points along x, y, z by which a box is sampled where a camera stands among its corners."""


@dataclass(frozen=True)
class Volume:
    """The box in the marker frame, mm, in which a surface is looked for: low (3,), high (3,)."""

    low: Floats
    high: Floats

    @property
    def vertices(self) -> Floats:
        """The eight corners, (8, 3)."""
        return np.array(
            [
                [x, y, z]
                for x in (self.low[0], self.high[0])
                for y in (self.low[1], self.high[1])
                for z in (self.low[2], self.high[2])
            ]
        )

    @property
    def lattice(self) -> Floats:
        """Points (N, 3) evenly over the box, its corners among them."""
        return lattice_over(self.low, self.high)

    @property
    def centre(self) -> Floats:
        """(3,) mm."""
        return (self.low + self.high) / 2


def lattice_over(low: Floats, high: Floats) -> Floats:
    """Points (N, 3) evenly over the box from ``low`` to ``high`` (3,), its corners among them."""
    axes = [np.linspace(a, b, count) for a, b, count in zip(low, high, LATTICE, strict=True)]
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], -1)


def volume_over(
    corners: Floats, poses: Sequence[Pose] = (), *, height_share: float = 0.35, below_mm: float = 2.0
) -> Volume:
    """The box over the markers' corners (Q, 4, 3), as high as ``height_share`` of the layout's diagonal, but no higher
    than the cameras mostly are: over a wide layout a phone may be held lower than that.

    It reaches a third of a marker's edge beyond the corners, so that whole cards lie in it.
    """
    points = corners.reshape(-1, 3)
    margin = np.array([1.0, 1.0, 0.0]) * np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1).mean() / 3
    low, high = points.min(0) - margin, points.max(0) + margin
    top = high[2] + height_share * float(np.linalg.norm((high - low)[:2]))
    if len(poses):
        top = max(min(top, float(np.median([p.centre[2] for p in poses]))), high[2] + below_mm)
    return Volume(np.array([low[0], low[1], low[2] - below_mm]), np.array([high[0], high[1], top]))


def inside_volume(depth: Singles, virtual: Intrinsics, R: Floats, pose: Pose, volume: Volume) -> Singles:
    """Depths whose points lie outside the volume become 0."""
    height, width = depth.shape
    x = ((np.arange(width) - virtual.cx) / virtual.focal_px).astype(np.float32)
    y = ((np.arange(height) - virtual.cy) / virtual.focal_px).astype(np.float32)[:, None]
    R = R.astype(np.float32)
    keep = np.ones(depth.shape, bool)
    for axis in range(3):
        place = (x * R[0, axis] + (y * R[1, axis] + R[2, axis])) * depth
        place += np.float32(pose.centre[axis])
        keep &= (place >= volume.low[axis]) & (place <= volume.high[axis])
    return np.where(keep, depth, 0).astype(np.float32)
