"""Measure how much fine texture photos show at the specimen, which image features need.

The measure is the share of a region whose structure tensor (Foerstner 1987) has a smaller eigenvalue above the photo's
noise: there the brightness changes in every direction, at the scale of a feature's inner detail. Coarse shading, edges
and smooth highlights do not count.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Flags, Floats, Singles
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.photos.reading import Photo

DETAIL_PX = 1.0
"""Detail much longer than this sd of a Gaussian is shading, not texture. It is the sd of the tensor's window, too."""
ABOVE_NOISE = 3.0
"""Gradients, RMS in the direction of the weaker, count from this multiple of what noise alone gives."""
LEAST_NOISE = 0.5
"""Singles levels: finer than half a step nothing is recorded, and compression removes it first."""
BLOCK_PX = 16
SMOOTHEST = 0.1
"""Of all blocks of a photo, the smoothest share shows its noise."""
CARD_EDGES = 1.7
"""A marker with its white card is this many of its edges wide at most."""
LEAST_PX = 400
MUCH, SOME = 0.9, 0.75
"""On phantoms of 512 pixels, texture contrasts of 1 and 0.5 lie above the first, 0.25 between, 0.1 and 0 below both."""
MOST_PHOTOS = 12


def textured_share(grey: NDArray[np.uint8], region: Flags | None = None) -> float:
    """Share, 0 to 1, of ``region`` (H, W; all by default) of a photo (H, W) that is textured above its noise."""
    image = np.asarray(grey, np.float32)
    gx, gy = _gradients(image)
    xx, xy, yy = (cv2.GaussianBlur(product, (0, 0), DETAIL_PX) for product in (gx * gx, gx * gy, gy * gy))
    weaker = (xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    textured = weaker > _noise_energy() * (ABOVE_NOISE * max(_noise(image), LEAST_NOISE)) ** 2
    return float(np.mean(textured if region is None else textured[region]))


def _gradients(image: Singles) -> tuple[Singles, Singles]:
    detail = image - cv2.GaussianBlur(image, (0, 0), DETAIL_PX)
    return (
        np.asarray(cv2.Sobel(detail, cv2.CV_32F, 1, 0), np.float32),
        np.asarray(cv2.Sobel(detail, cv2.CV_32F, 0, 1), np.float32),
    )


def _noise_energy() -> float:
    """Mean square of a gradient where the image is noise of sd 1."""
    impulse = np.zeros((33, 33), np.float32)
    impulse[16, 16] = 1
    return float((_gradients(impulse)[0] ** 2).sum())


def _noise(image: Singles) -> float:
    """Sd of the noise, grey levels, in the smoothest blocks (Immerkaer 1996's mask, which no slope moves)."""
    mask = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
    rows, cols = (size // BLOCK_PX for size in image.shape)
    if not rows * cols:
        return 0.0
    answer = np.abs(cv2.filter2D(image, cv2.CV_32F, mask))[: rows * BLOCK_PX, : cols * BLOCK_PX]
    blocks = answer.reshape(rows, BLOCK_PX, cols, BLOCK_PX).swapaxes(1, 2).reshape(rows * cols, -1)
    return float(SIGMA_OF_MAD * np.quantile(np.median(blocks, axis=1), SMOOTHEST))


def between_markers(lens: Intrinsics, pose: Pose, corners: Floats, size: tuple[int, int]) -> Flags | None:
    """Pixels (H, W) of a photo of ``size`` (width, height) inside the markers' hull and on no card.

    ``corners`` (Q, 4, 3) mm. None where the hull is next to nothing, as with one or two markers.
    """
    middles = corners.mean(1)
    cards = middles[:, None] + CARD_EDGES * (corners - middles[:, None])
    mask = np.zeros((size[1], size[0]), np.uint8)

    def fill(points: Floats, value: int) -> None:
        hull = cv2.convexHull(np.rint(lens.project(pose.apply(points))).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, value)

    fill(middles, 1)
    for card in cards:
        fill(card, 0)
    return mask > 0 if mask.sum() >= LEAST_PX else None


def usual_share(photos: Iterable[tuple[Photo, Flags | None]]) -> float:
    """Median of the photos' shares, each within its region; of many photos an even choice is looked at."""
    all_photos = list(photos)
    step = -(-len(all_photos) // MOST_PHOTOS)
    return float(np.median([textured_share(photo.grey, region) for photo, region in all_photos[::step]]))


def in_words(share: float, region: str) -> str:
    """Describe a share of ``region`` for a warning."""
    how = "much" if share >= MUCH else "some" if share >= SOME else "little"
    return f"{100 * share:.0f} % of {region} shows fine texture above the noise: {how}."
