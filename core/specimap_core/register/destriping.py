"""Remove stripes from an image: dead and hot columns, and lines of a lost exposure."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from specimap_core.geometry.robust import SIGMA_OF_MAD

WIDEST_PX = 9
"""Widest stripe that is distinguished from what the image shows."""
UNLIKE = 3.0
"""A line is a stripe where most of it differs from its surroundings by so many usual differences, to one side."""
MOST = 0.6
"""How much of it must: on phantoms no line differs so over more than 0.17 of its length, dead ones over all of it."""


def destriped(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """The image (rows, cols) with what lies on stripes interpolated from their surroundings."""
    filled = _without_columns(np.asarray(image, np.float32))
    return np.ascontiguousarray(_without_columns(filled.T).T)


def _without_columns(image: NDArray[np.float32]) -> NDArray[np.float32]:
    cols = image.shape[1]
    if cols < 4 * WIDEST_PX:
        return image
    finite = np.isfinite(image)
    middle = np.float32(np.median(image[finite])) if finite.any() else np.float32(0)
    known = np.where(finite, image, middle)
    off = known - median_filter(known, (1, 2 * WIDEST_PX + 1), mode="mirror")
    # What is usual is measured around the place itself: a bright part of the scene varies more than a dark one.
    usual = SIGMA_OF_MAD * np.median(np.abs(off), axis=1, keepdims=True) + 1e-6 * (np.abs(middle) + 1e-6)
    share = np.maximum((off > UNLIKE * usual).mean(0), (off < -UNLIKE * usual).mean(0))
    bad = (share > MOST) | (~finite).all(0)
    if not bad.any() or bad.all():
        return image
    good = np.flatnonzero(~bad)
    left = good[np.clip(np.searchsorted(good, np.flatnonzero(bad)) - 1, 0, len(good) - 1)]
    right = good[np.clip(np.searchsorted(good, np.flatnonzero(bad)), 0, len(good) - 1)]
    gap = np.maximum(right - left, 1)
    share_right = ((np.flatnonzero(bad) - left) / gap).clip(0, 1).astype(np.float32)
    out = image.copy()
    out[:, bad] = image[:, left] * (1 - share_right) + image[:, right] * share_right
    return out
