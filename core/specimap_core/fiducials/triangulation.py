"""Marker corners in space, from their rays in the photos."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, Pose

LEAST_PARALLAX = 1e-5
"""Angle in radians between rays below which the place where they meet is open: far less than a pixel spans."""


def triangulate(lens: Intrinsics, poses: tuple[Pose, ...], seen: Observations, count: int) -> Floats:
    """Corners (count, 4, 3) nearest to their rays, in the frame of ``poses``; NaN where fewer than two rays, or rays
    that all run alike, leave one open."""
    R, centres = (np.stack(x)[seen.photo] for x in ([p.R for p in poses], [p.centre for p in poses]))
    d = lens.rays(seen.corners_px) @ R
    d = d / np.linalg.norm(d, axis=-1, keepdims=True)
    across = np.eye(3) - d[..., :, None] * d[..., None, :]
    A, b = np.zeros((count, 4, 3, 3)), np.zeros((count, 4, 3))
    np.add.at(A, seen.marker, across)
    np.add.at(b, seen.marker, (across @ centres[:, None, :, None])[..., 0])
    corners = np.full((count, 4, 3), np.nan)
    shared = (np.bincount(seen.marker, minlength=count) >= 2) & np.isfinite(A).all(axis=(1, 2, 3))
    # The least eigenvalue is the sum of the squared sines between the rays and their common direction.
    apart = np.linalg.eigvalsh(A[shared])[..., 0] > LEAST_PARALLAX**2
    shared[shared] = apart.all(1)
    corners[shared] = np.linalg.solve(A[shared], b[shared][..., None])[..., 0]
    return corners
