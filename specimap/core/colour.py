"""sRGB's encoding and linear light (IEC 61966-2-1)."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

Singles = NDArray[np.float32]


@cache
def _linear_bytes() -> Singles:
    v = np.arange(256) / 255
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4).astype(np.float32)


def linear_from_srgb(image: NDArray[np.uint8]) -> Singles:
    """sRGB bytes to linear light in 0..1, same shape."""
    return np.asarray(_linear_bytes()[image])


def srgb_from_linear(linear: Singles) -> Singles:
    """Linear light to sRGB's encoding, both 0..1; values outside are clipped."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(x, 1 / 2.4, dtype=np.float32) - 0.055).astype(
        np.float32
    )
