"""Marker corners as observed in photos."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Ints
from specimap_core.geometry.cameras import Pose


@dataclass(frozen=True)
class Observations:
    """M markers seen in photos.

    ``photo`` and ``marker`` (M,): indices; ``corners_px`` (M, 4, 2); ``sigma_px`` (M,) of a coordinate.
    """

    photo: Ints
    marker: Ints
    corners_px: Floats
    sigma_px: Floats

    def of(self, keep: NDArray[np.bool_]) -> Observations:
        """Those where ``keep`` (M,) is true."""
        return Observations(self.photo[keep], self.marker[keep], self.corners_px[keep], self.sigma_px[keep])


def square_corners(edge_mm: float) -> Floats:
    """Corners (4, 3) of a marker in its own frame: x right, y up, z out of the print; origin at its centre."""
    h = edge_mm / 2
    return np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])


def corners_of(squares: tuple[Pose, ...], edge_mm: float) -> Floats:
    """World corners (Q, 4, 3) mm of square markers with poses ``world_from_marker``."""
    return np.stack([s.apply(square_corners(edge_mm)) for s in squares])


def corner_shifts(corners_px: Floats) -> Floats:
    """By how much (..., 4, 2) the corners (..., 4, 2) of squares move where each edge moves outward by one pixel."""
    along = np.roll(corners_px, -1, -2) - corners_px
    normal = np.stack([along[..., 1], -along[..., 0]], -1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    outward = ((corners_px - corners_px.mean(-2, keepdims=True)) * normal).sum(-1, keepdims=True)
    normal = normal * np.where(outward < 0, -1.0, 1.0) / np.maximum(length, 1e-12)
    before = np.roll(normal, 1, -2)
    # n1 . d = n2 . d = 1: along the bisector, further where the edges meet at a smaller angle.
    return np.asarray((before + normal) / np.maximum(1 + (before * normal).sum(-1, keepdims=True), 1e-3))
