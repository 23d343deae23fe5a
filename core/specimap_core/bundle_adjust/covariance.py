"""Marginal covariance of the adjusted marker corners."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.solver import MarkerScene, SolveInfo
from specimap_core.geometry.cameras import skew


def corner_covariance(scene: MarkerScene, info: SolveInfo) -> Floats:
    """Marginal covariance (12 Q, 12 Q) mm^2 of all corners, in the frame that the corners themselves define.

    The choice of frame is removed by projecting the rigid motions out of the corners (an S-transformation,
    Baarda 1973), so that a variance is that of a corner's place within the layout.
    """
    Q = len(scene.corners)
    shared, photo, _ = scene.sizes
    start = shared + photo * len(scene.poses)
    full = np.linalg.pinv(info.normal, rcond=1e-12, hermitian=True)
    block = full[start:, start:]
    if scene.squares is not None:
        B = np.zeros((12 * Q, 6 * Q))
        for q, square in enumerate(scene.squares):
            arm = scene.corners[q] - square.t
            for c in range(4):
                row = 12 * q + 3 * c
                B[row : row + 3, 6 * q : 6 * q + 6] = np.hstack([-skew(arm[c]), np.eye(3)])
        block = B @ block @ B.T
    points = scene.corners.reshape(-1, 3)
    motions = np.concatenate([np.tile(np.eye(3), (len(points), 1, 1)), -skew(points - points.mean(0))], -1).reshape(
        -1, 6
    )
    q_basis, _ = np.linalg.qr(motions)
    keep = np.eye(12 * Q) - q_basis @ q_basis.T
    return np.asarray(keep @ block @ keep)
