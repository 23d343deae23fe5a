"""Images looked up between their pixels, at any number of places and in images of any size."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np

from specimap_core.arrays import Floats, Singles

MOST = 32_766
"""OpenCV's ``remap`` takes fewer rows and columns than 2^15, of what it reads and of what it gives."""
ROW = 256
"""Places in a row of what it is asked for, where these come in none of their own."""
MARGIN = 4
"""Pixels around a place that interpolation may read, and one to spare."""


def sample(image: Singles, x: Floats | Singles, y: Floats | Singles, interpolation: int = cv2.INTER_LINEAR) -> Singles:
    """What an image (H, W) shows at columns ``x`` and rows ``y``, in their shape (any); 0 outside.

    Pixel centres are at integers.
    """
    x, y = np.asarray(x, np.float32), np.asarray(y, np.float32)
    if max(image.shape) > MOST:
        return _in_tiles(image, x, y, interpolation)
    if x.ndim == 2 and 0 < x.shape[0] <= MOST and 1 < x.shape[1] <= MOST:
        return np.asarray(cv2.remap(image, x, y, interpolation))
    flat_x, flat_y = x.ravel(), y.ravel()
    out = np.empty(len(flat_x), np.float32)
    for part in _parts(len(flat_x)):
        shape = (-1, ROW) if (part.stop - part.start) % ROW == 0 else (1, -1)
        out[part] = cv2.remap(image, flat_x[part].reshape(shape), flat_y[part].reshape(shape), interpolation).ravel()
    return out.reshape(x.shape)


def _parts(count: int) -> Iterator[slice]:
    """Whole rows, as many as fit at a time, then what is left."""
    whole = count // ROW * ROW
    yield from (slice(k, min(k + MOST * ROW, whole)) for k in range(0, whole, MOST * ROW))
    if whole < count:
        yield slice(whole, count)


def _in_tiles(image: Singles, x: Singles, y: Singles, interpolation: int) -> Singles:
    """The same from pieces of an image that is too large for one call, each with the places that lie in it."""
    side = MOST - 2 * MARGIN
    tile_x, tile_y = np.floor(x / side), np.floor(y / side)
    out = np.zeros(x.shape, np.float32)
    for top in range(0, image.shape[0], side):
        for left in range(0, image.shape[1], side):
            here = (tile_x == left // side) & (tile_y == top // side)
            if not here.any():
                continue
            y0, x0 = max(top - MARGIN, 0), max(left - MARGIN, 0)
            piece = image[y0 : top + side + MARGIN, x0 : left + side + MARGIN]
            out[here] = sample(piece, x[here] - x0, y[here] - y0, interpolation)
    return out
