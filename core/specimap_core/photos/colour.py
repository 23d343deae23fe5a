"""sRGB's encoding and linear light (IEC 61966-2-1)."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Singles


@cache
def _linear_bytes() -> Floats:
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def linear_from_srgb(image: NDArray[np.uint8], power: float = 1.0) -> Singles:
    """sRGB bytes to linear light in 0..1 to a ``power``, same shape."""
    linear = np.empty(image.shape, np.float32)
    if image.size:  # of nothing OpenCV makes nothing, not an empty array
        cv2.LUT(image.reshape(-1, 1), (_linear_bytes() ** power).astype(np.float32), linear.reshape(-1, 1))
    return linear


def srgb_from_linear(linear: Singles) -> Singles:
    """Linear light to sRGB's encoding, both 0..1; values outside are clipped."""
    x = np.clip(linear, 0, 1)
    encoded = np.power(x, 1 / 2.4, dtype=np.float32)
    encoded *= 1.055
    encoded -= 0.055
    return np.asarray(np.multiply(x, 12.92, out=encoded, where=x <= 0.0031308))
