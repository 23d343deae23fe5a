"""The depth map of one photo."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Bytes, Floats, Singles
from specimap_core.geometry.cameras import Intrinsics, Pose, View


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
