"""The projection's derivatives, by the point and by the lens."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics

LENS = 5
"""Unknowns of a lens: logarithm of the focal length, cx, cy, k1, k2."""


def projection_derivatives(lens: Intrinsics, cam: Floats, measured: Floats) -> tuple[Floats, Floats, Floats]:
    """Residual (M, 4, 2), its derivative by the camera point (M, 4, 2, 3) and by the lens (M, 4, 2, 5)."""
    z = np.where(np.abs(cam[..., 2]) < 1e-6, 1e-6, cam[..., 2])
    xy = cam[..., :2] / z[..., None]
    r2 = (xy * xy).sum(-1)
    radial = 1 + r2 * (lens.k1 + r2 * lens.k2)
    f = lens.focal_px
    offset = f * xy * radial[..., None]
    residual = offset + np.array([lens.cx, lens.cy]) - measured
    d_xy = f * (
        radial[..., None, None] * np.eye(2)
        + 2 * (lens.k1 + 2 * lens.k2 * r2)[..., None, None] * xy[..., :, None] * xy[..., None, :]
    )
    d_cam = np.zeros((*xy.shape, 3))
    d_cam[..., :2] = d_xy / z[..., None, None]
    d_cam[..., 2] = -(d_xy @ xy[..., None])[..., 0] / z[..., None]
    d_lens = np.zeros((*xy.shape, LENS))
    d_lens[..., 0] = offset
    d_lens[..., 0, 1] = d_lens[..., 1, 2] = 1
    d_lens[..., 3] = f * xy * r2[..., None]
    d_lens[..., 4] = f * xy * (r2**2)[..., None]
    return residual, d_cam, d_lens
