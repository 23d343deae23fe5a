"""Points from their two rays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose

TRIANGULATION_PX = 2.0


def triangulate_pair(
    lens: Intrinsics, poses: tuple[Pose, Pose], xy: tuple[Floats, Floats]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Midpoints (M, 3) of the rays of matches (M, 2), and which reproject within two pixels in both."""
    centres = [p.centre for p in poses]
    d = [lens.rays(x) @ p.R for x, p in zip(xy, poses, strict=True)]
    d = [v / np.linalg.norm(v, axis=1, keepdims=True) for v in d]
    w = centres[0] - centres[1]
    b = (d[0] * d[1]).sum(1)
    d0, d1 = d[0] @ w, d[1] @ w
    denominator = np.maximum(1 - b * b, 1e-9)
    s, t = (b * d1 - d0) / denominator, (d1 - b * d0) / denominator
    points = (centres[0] + s[:, None] * d[0] + centres[1] + t[:, None] * d[1]) / 2
    good = (s > 0) & (t > 0) & (denominator > 1e-3)
    for pose, measured in zip(poses, xy, strict=True):
        cam = pose.apply(points)
        cam[:, 2] = np.maximum(cam[:, 2], 1e-6)
        good &= np.linalg.norm(lens.project(cam) - measured, axis=1) < TRIANGULATION_PX
    return points, good
