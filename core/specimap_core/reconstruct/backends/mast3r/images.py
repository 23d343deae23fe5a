"""Photos as the network sees them, and the way between their pixels and the network's."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics

PATCH_PX = 16


@dataclass(frozen=True)
class Preparation:
    """How a photo of ``photo_size`` (width, height) becomes the network's image of ``size``.

    It is resized to ``resized`` (width, height), then cut at ``left``, ``top``; a pixel x goes to
    ``(x + 0.5) * resized / photo - 0.5 - left``, centres at integers on both sides.
    """

    photo_size: tuple[int, int]
    resized: tuple[int, int]
    left: int
    top: int
    size: tuple[int, int]

    @property
    def scale(self) -> Floats:
        """Network pixels over photo pixels, (2,): x, y. The two differ by the rounding of ``resized``."""
        return np.asarray(np.array(self.resized, float) / np.array(self.photo_size, float))

    def to_network(self, photo_px: Floats) -> Floats:
        """Photo pixels (..., 2) to network pixels."""
        return np.asarray((photo_px + 0.5) * self.scale - 0.5 - [self.left, self.top])

    def to_photo(self, network_px: Floats) -> Floats:
        """Inverse of :meth:`to_network`."""
        return np.asarray((network_px + 0.5 + [self.left, self.top]) / self.scale - 0.5)

    def photo_lens(self, focal_px: float, centre_px: Floats) -> Intrinsics:
        """The photo's lens, given focal length and principal point (2,) in network pixels.

        Pixels are square: where rounding stretched an axis (at most 0.5 px of the shorter side), the mean counts.
        """
        cx, cy = self.to_photo(np.asarray(centre_px, float))
        width, height = self.photo_size
        return Intrinsics(width, height, focal_px / math.sqrt(float(self.scale.prod())), float(cx), float(cy))

    def apply(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The image (H, W, 3) as the network gets it, exactly as upstream prepares it."""
        # Upstream's filters: Lanczos to shrink, bicubic to enlarge.
        shrinks = max(self.photo_size) > max(self.resized)
        method = Image.Resampling.LANCZOS if shrinks else Image.Resampling.BICUBIC
        resized = np.asarray(Image.fromarray(image).resize(self.resized, method))
        width, height = self.size
        return np.ascontiguousarray(resized[self.top : self.top + height, self.left : self.left + width])


def plan_preparation(photo_size: tuple[int, int], longer_px: int) -> Preparation:
    """Longer side to ``longer_px``, then cut about the centre to whole patches of 16; squares stay whole.

    The same as upstream's ``load_images(size, square_ok=True)``.
    """
    longer = max(photo_size)
    width, height = (round(v * longer_px / longer) for v in photo_size)
    cut_w, cut_h = (2 * (v // 2) // PATCH_PX * PATCH_PX for v in (width, height))
    return Preparation(photo_size, (width, height), width // 2 - cut_w // 2, height // 2 - cut_h // 2, (cut_w, cut_h))
