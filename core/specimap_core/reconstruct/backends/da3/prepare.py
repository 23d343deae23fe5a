"""Photos as the network sees them: undistorted, resized, cut to whole patches; and which it sees together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from specimap_core.arrays import Bytes, Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.reconstruct.backends.da3.settings import PATCH_PX
from specimap_core.reconstruct.dense.cross_check import viewing_directions
from specimap_core.reconstruct.dense.stereo import antialiased


@dataclass(frozen=True)
class Preparation:
    """How photos of ``lens`` become the network's images of ``size`` (width, height).

    With distortion undone, a photo's pixel x goes to ``(x + 0.5) * scale - 0.5 - cut``, centres at integers on both
    sides; ``cut`` (x, y) may be a fraction, since the image is resampled once, by the whole map.
    """

    lens: Intrinsics
    scale: float
    cut: tuple[float, float]
    size: tuple[int, int]

    @cached_property
    def intrinsics(self) -> Intrinsics:
        """The network image's camera, without distortion."""
        cx, cy = self.to_network(np.array([self.lens.cx, self.lens.cy]))
        return Intrinsics(*self.size, self.lens.focal_px * self.scale, float(cx), float(cy))

    def to_network(self, undistorted_px: Floats) -> Floats:
        """Undistorted photo pixels (..., 2) to network pixels."""
        return np.asarray((undistorted_px + 0.5) * self.scale - 0.5 - np.array(self.cut))

    def to_photo(self, network_px: Floats) -> Floats:
        """Inverse of :meth:`to_network`."""
        return np.asarray((network_px + 0.5 + np.array(self.cut)) / self.scale - 0.5)

    def apply(self, image: Bytes) -> Bytes:
        """The photo (H, W, 3) as the network's image."""
        maps = cv2.initUndistortRectifyMap(
            self.lens.matrix, self.lens.distortion, np.eye(3), self.intrinsics.matrix, self.size, cv2.CV_32FC1
        )
        image = antialiased(image, self.scale)
        return np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE), np.uint8)


def plan_preparation(lens: Intrinsics, longer_px: int) -> Preparation:
    """Longer side to ``longer_px``, then cut about the centre to whole patches of 14 pixels.

    Upstream stretches to whole patches instead; cutting keeps pixels square.
    """
    scale = longer_px / max(lens.width, lens.height)
    full = lens.width * scale, lens.height * scale
    # The longer side is a multiple already, but for rounding.
    width, height = (max(1, int((v + 1e-6) // PATCH_PX)) * PATCH_PX for v in full)
    return Preparation(lens, scale, ((full[0] - width) / 2, (full[1] - height) / 2), (width, height))


def windows(poses: tuple[Pose, ...], target: Floats, most: int) -> list[list[int]]:
    """Photos in groups of ``most`` at most, each of neighbours around ``target``, all about as large."""
    towards = viewing_directions(poses, target)
    order = np.argsort(np.arctan2(towards[:, 1], towards[:, 0]), kind="stable")
    return [[int(k) for k in part] for part in np.array_split(order, -(-len(poses) // most))]


def conditioning(poses: list[Pose]) -> Floats:
    """Poses (N, 4, 4) ``cam_from_world`` as the network takes them: the first is the origin, the middle distance 1."""
    first = poses[0].inverse()
    relative = np.stack([(p @ first).matrix for p in poses])
    distances = np.sort([float(np.linalg.norm(p.centre - poses[0].centre)) for p in poses])
    middle = distances[(len(distances) - 1) // 2] or distances[-1] or 1.0
    relative[:, :3, 3] /= middle
    return relative
