"""The marker layout as a frame and a scale: where the origin is, which way is up, how long a millimetre is."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.fiducials.observations import square_corners
from specimap_core.geometry.cameras import Pose, fit_similarity


def marker_frame(corners: Floats, camera_centres: Floats) -> Pose:
    """``marker_from_world``: the rigid transform into the marker frame.

    Origin at the centroid of all corners (Q, 4, 3), the markers in the order of their ids; z along the plane's
    normal toward the cameras (N, 3); x from the centroid toward the first marker, projected into the plane.
    """
    points = corners.reshape(-1, 3)
    origin = points.mean(0)
    z = np.linalg.svd(points - origin, full_matrices=False)[2][2]
    if np.median((camera_centres - origin) @ z) < 0:
        z = -z
    x = corners[0].mean(0) - origin
    x = x - (x @ z) * z
    if np.linalg.norm(x) < 1e-6 * np.abs(points - origin).max():
        # A single marker is its own centroid: its top edge gives x.
        x = corners[0, 1] - corners[0, 0]
        x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return Pose(R, -R @ origin)


def edge_lengths(corners: Floats) -> Floats:
    """Lengths (Q, 4) of the markers' edges, corners (Q, 4, 3)."""
    return np.asarray(np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=-1))


def rigid_square(corners: Floats, edge_mm: float) -> Pose:
    """``world_from_marker`` of the square of known edge that lies closest to four corners (4, 3)."""
    _, R, t = fit_similarity(square_corners(edge_mm), corners)
    return Pose(R, t)
