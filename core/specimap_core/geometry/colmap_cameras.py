"""Cameras as COLMAP has them: its half pixel is added and removed here alone."""

from __future__ import annotations

import numpy as np
import pycolmap

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics

COLMAP_HALF_PIXEL = 0.5


def colmap_from_opencv(points_px: Floats) -> Floats:
    """Pixel coordinates (..., 2) with centres at integers to COLMAP's, whose centres are at halves."""
    return points_px + COLMAP_HALF_PIXEL


def opencv_from_colmap(points_px: Floats) -> Floats:
    """Inverse of :func:`colmap_from_opencv`."""
    return points_px - COLMAP_HALF_PIXEL


def colmap_camera(lens: Intrinsics) -> pycolmap.Camera:
    """The same lens as a COLMAP camera (RADIAL), half a pixel moved."""
    cx, cy = colmap_from_opencv(np.array([lens.cx, lens.cy]))
    return pycolmap.Camera(
        model="RADIAL",
        width=lens.width,
        height=lens.height,
        params=[lens.focal_px, cx, cy, lens.k1, lens.k2],
    )
