"""Pictures of markers whose corners are known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Bytes, Floats
from specimap_core.fiducials.detection import dictionary_named
from specimap_core.photos.colour import srgb_from_linear


def picture(
    markers: dict[int, Floats],
    *,
    dictionary: str = "DICT_4X4_50",
    shape: tuple[int, int] = (300, 400),
    blur_px: float = 0.8,
    noise: float = 1.0,
    seed: int = 0,
) -> Bytes:
    """A grey sRGB picture with markers whose outer corners (4, 2) lie exactly at the given places.

    Drawn eight times as large in linear light, averaged, blurred, then encoded: as a lens and a sensor do it.
    """
    fine = 8
    averaged: NDArray[np.float32] = np.full(shape, 0.75, np.float32)
    for marker_id, corners in markers.items():
        drawn = cv2.aruco.generateImageMarker(dictionary_named(dictionary), marker_id, 240)
        cells = drawn.shape[0]
        # Only where the marker lies: all of a large picture, eight times as large, takes gigabytes.
        low = np.maximum(np.floor(corners.min(0)).astype(int) - 1, 0)
        high = np.minimum(np.ceil(corners.max(0)).astype(int) + 2, shape[::-1])
        width, height = high - low
        # The black square ends half a pixel outside the outermost pixels' centres.
        source = np.array([[-0.5, -0.5], [cells - 0.5, -0.5], [cells - 0.5, cells - 0.5], [-0.5, cells - 0.5]])
        target = (corners - low + 0.5) * fine - 0.5
        H = cv2.getPerspectiveTransform(source.astype(np.float32), target.astype(np.float32))
        size = int(width) * fine, int(height) * fine
        mask = cv2.warpPerspective(np.ones_like(drawn), H, size, flags=cv2.INTER_NEAREST)
        warped = cv2.warpPerspective(drawn, H, size, flags=cv2.INTER_NEAREST)
        box = averaged[low[1] : high[1], low[0] : high[0]]
        linear = np.repeat(np.repeat(box, fine, 0), fine, 1)
        linear[mask > 0] = np.where(warped[mask > 0] > 127, 0.75, 0.03)
        box[:] = cv2.resize(linear, (int(width), int(height)), interpolation=cv2.INTER_AREA)
    light = cv2.GaussianBlur(averaged, (0, 0), blur_px)
    encoded = np.asarray(srgb_from_linear(light), float) * 255
    encoded = encoded + noise * np.random.default_rng(seed).standard_normal(encoded.shape)
    return np.asarray(np.clip(encoded + 0.5, 0, 255), np.uint8)


def square(x: float, y: float, size: float, angle_deg: float = 0.0, lean: float = 0.0) -> Floats:
    """A square seen at an angle: top-left, top-right, bottom-right, bottom-left."""
    a = np.radians(angle_deg)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    unit = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5 + lean, 0.5], [-0.5 + lean, 0.5]])
    return np.asarray(np.array([x, y]) + size * unit @ turn.T)


LAYOUT = {
    0: square(80.3, 70.7, 41.2, 12, 0.2),
    1: square(300.6, 80.1, 38.5, -33, -0.15),
    2: square(310.2, 220.4, 44.9, 61, 0.1),
    3: square(90.8, 215.9, 36.4, 175),
}
