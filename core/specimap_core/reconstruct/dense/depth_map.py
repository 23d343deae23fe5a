"""One view's depth map, and the settings that depth is measured with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from specimap_core.geometry.cameras import Floats, Intrinsics, Pose, View
from specimap_core.reconstruct.dense.device import Device
from specimap_core.reconstruct.dense.volume import Singles

Bytes = NDArray[np.uint8]


@dataclass(frozen=True)
class DepthSettings:
    """Dense matching.

    ``angle_deg``: least, best and widest angle between two photos' directions to the scene. ``wide_angle_deg``:
    the widest angle where a photo has no nearer neighbour. ``pairs_per_photo``: partners of each photo; one
    fewer from ``many_photos`` on, since every place is then seen by more photos anyway. ``block_px``: matching
    window. ``matching_share`` and ``most_matching_px``: photos are matched at this share of their size, and no larger;
    the mesh is refined on the photos as they are, after which it is as good as from full-size matching.
    ``uniqueness``: per cent by which the best match must win. ``device``: where depth is measured; ``auto``
    is a GPU where one is in sight.
    """

    angle_deg: tuple[float, float, float] = (4.0, 14.0, 30.0)
    wide_angle_deg: float = 42.0
    pairs_per_photo: int = 3
    many_photos: int = 32
    block_px: int = 3
    matching_share: float = 0.6
    most_matching_px: int = 512
    uniqueness: int = 8
    device: Device = "auto"

    def shrinkage(self, lens: Intrinsics) -> float:
        """Factor by which photos of ``lens`` are shrunk before they are matched."""
        return min(self.matching_share, self.most_matching_px / max(lens.width, lens.height))


@dataclass(frozen=True)
class DepthMap:
    """Depth of one photo, in a virtual camera at the photo's place.

    ``photo``: index of the posed photo. ``turn`` (3, 3): ``virtual_from_photo`` rotation. ``intrinsics``: of the
    virtual, undistorted camera. ``depth`` (H, W) along z in mm, 0 where unknown. ``confidence`` (H, W) uint8,
    255 for sure. ``colour`` (H, W, 3) sRGB uint8 seen there.
    """

    photo: int
    turn: Floats
    intrinsics: Intrinsics
    depth: Singles
    confidence: Bytes
    colour: Bytes

    def view(self, pose: Pose) -> View:
        """The virtual camera, given the photo's (refined) ``cam_from_world``."""
        return View(self.intrinsics, Pose(self.turn @ pose.R, self.turn @ pose.t))

    def points(self, pose: Pose, most: int | None = None) -> Floats:
        """Places (N, 3) mm of the known depths in the world of ``pose``, evenly thinned to about ``most``."""
        rows, cols = np.nonzero(self.depth)
        step = max(1, len(rows) // most) if most else 1
        rows, cols = rows[::step], cols[::step]
        cam = self.intrinsics.rays(np.stack([cols, rows], -1).astype(float)) * self.depth[rows, cols, None]
        return self.view(pose).cam_from_world.inverse().apply(cam)


def cropped_map(
    photo: int,
    turn: Floats,
    virtual: Intrinsics,
    depth: Singles,
    colour: Bytes,
    confidence: Bytes | None = None,
) -> DepthMap | None:
    """The part of the window that holds depth, sure of all of it by default; None where too little does."""
    rows, cols = np.flatnonzero(depth.any(1)), np.flatnonzero(depth.any(0))
    if len(rows) < 8 or len(cols) < 8:
        return None
    top, left, bottom, right = rows[0], cols[0], rows[-1] + 1, cols[-1] + 1
    part = np.ascontiguousarray(depth[top:bottom, left:right])
    lens = replace(
        virtual,
        width=int(right - left),
        height=int(bottom - top),
        cx=virtual.cx - float(left),
        cy=virtual.cy - float(top),
    )
    sure = np.full(depth.shape, 255, np.uint8) if confidence is None else confidence
    sure = np.where(part > 0, sure[top:bottom, left:right], 0).astype(np.uint8)
    return DepthMap(photo, turn, lens, part, sure, np.ascontiguousarray(colour[top:bottom, left:right]))
