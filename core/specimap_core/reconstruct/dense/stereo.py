"""Dense depth on a CPU: neighbouring photos rectified in pairs, semi-global matching.

A pair is rectified by a rotation of its own, with x along the baseline, so it does not matter how the phone was
rolled. Matching is OpenCV's StereoSGBM (Hirschmueller 2008), over the disparities of what stands in the volume.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Bytes, Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap, cropped_map
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import Volume, inside_volume, lattice_over

MOST_DISPARITIES = 512
OWN_BLUR_PX = 0.5
NEAREST_SHARE = 0.05
"""Of the farthest depth: what is nearer, or behind, a camera does not see sharply."""
LEAST_IN_VIEW = 4
"""Points of a box that two photos must share."""


def antialiased(image: Bytes, factor: float) -> Bytes:
    """The image (H, W, 3) without what it could not hold at ``factor`` of its size, which would alias."""
    if factor >= 1:
        return image
    # An image's own blur is about half its pixel; shrunk it must be half of the larger one.
    return np.asarray(cv2.GaussianBlur(image, (0, 0), OWN_BLUR_PX * float(np.sqrt(1 / factor**2 - 1))), np.uint8)


def viewing_angles_deg(poses: tuple[Pose, ...], target: Floats) -> Floats:
    """Degrees (P, P) between the directions from which photos look at ``target`` (3,)."""
    sight = np.stack([p.centre for p in poses]) - target
    sight = sight / np.linalg.norm(sight, axis=1)[:, None]
    return np.asarray(np.degrees(np.arccos(np.clip(sight @ sight.T, -1, 1))))


@dataclass(frozen=True)
class _Rectified:
    """``range_px``: least disparity and how many are searched."""

    lens: Intrinsics
    turns: tuple[Floats, Floats]
    baseline_mm: float
    range_px: tuple[int, int]


def _in_view(points: Floats, lens: Intrinsics, pose: Pose) -> NDArray[np.bool_]:
    """Which points (N, 3) lie before a camera and in its picture, distortion aside."""
    cam = pose.apply(points)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (lens.focal_px * cam[:, k] / cam[:, 2] for k in (0, 1))
    inside = (np.abs(u + lens.cx - lens.width / 2) < lens.width / 2) & (
        np.abs(v + lens.cy - lens.height / 2) < lens.height / 2
    )
    return np.asarray((cam[:, 2] > 0) & inside, bool)


def _rectify(lens: Intrinsics, first: Pose, second: Pose, content: Floats, shrinkage: float) -> _Rectified | None:
    """Virtual cameras for a pair, cut to where ``content`` (N, 3) shows, ``shrinkage`` as large as the photos; None
    where it cannot be rectified."""
    baseline = second.centre - first.centre
    length = float(np.linalg.norm(baseline))
    forward = first.R[2] + second.R[2]
    x = baseline / max(length, 1e-9)
    z = forward - (forward @ x) * x
    if length < 1e-6 or np.linalg.norm(z) < 0.5:
        return None
    z = z / np.linalg.norm(z)
    R = np.stack([x, np.cross(z, x), z])
    focal_px = shrinkage * lens.focal_px
    cam = (content - first.centre) @ R.T
    if cam[:, 2].min() <= NEAREST_SHARE * cam[:, 2].max():
        # A camera among the content: what it can see of the content's box, as near as disparities go.
        box = lattice_over(content.min(0), content.max(0))
        cam = (box[_in_view(box, lens, first) & _in_view(box, lens, second)] - first.centre) @ R.T
        farthest = float(cam[:, 2].max(initial=0))
        nearest = focal_px * length / (MOST_DISPARITIES - 32 + focal_px * length / max(farthest, 1e-9))
        cam = cam[cam[:, 2] > max(nearest, NEAREST_SHARE * farthest)]
    if len(cam) < LEAST_IN_VIEW:
        return None
    pixels = focal_px * cam[:, :2] / cam[:, 2:]
    most = 1.3 * shrinkage * np.array([lens.width, lens.height])
    low, high = np.maximum(pixels.min(0), -most), np.minimum(pixels.max(0), most)
    width, height = (int(v) for v in np.ceil(high - low) + 1)
    if width < 32 or height < 32:
        return None
    virtual = Intrinsics(width, height, focal_px, float(-low[0]), float(-low[1]))
    disparity = focal_px * length / cam[:, 2]
    least = int(np.floor(disparity.min())) - 1
    count = -(-(int(np.ceil(disparity.max())) + 1 - least) // 16) * 16
    if count > MOST_DISPARITIES:
        return None
    return _Rectified(virtual, (R @ first.R.T, R @ second.R.T), length, (least, count))


def _warp(image: Bytes, lens: Intrinsics, turn: Floats, virtual: Intrinsics, shift: float) -> Bytes:
    """The photo as the virtual camera sees it, moved ``shift`` columns to the right."""
    matrix = virtual.matrix
    matrix[0, 2] += shift
    maps = cv2.initUndistortRectifyMap(
        lens.matrix, lens.distortion, turn, matrix, (virtual.width, virtual.height), cv2.CV_32FC1
    )
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT))


def shared_share(lens: Intrinsics, first: Pose, second: Pose, content: Floats) -> float:
    """Share of ``content`` (N, 3) that a second photo shows, of what the first one does."""
    seen = _in_view(content, lens, first)
    return float((_in_view(content, lens, second) & seen).sum() / max(int(seen.sum()), 1))


def match_pair(
    images: tuple[Bytes, Bytes],
    lens: Intrinsics,
    poses: tuple[Pose, Pose],
    volume: Volume,
    content: Floats,
    photo: int,
    settings: DepthSettings,
    shrinkage: float = 1.0,
) -> DepthMap | None:
    """Depth of the first of two photos (H, W, 3) from both, searched over where ``content`` (N, 3) lies.

    ``shrinkage``: share of the photos' resolution that is matched. None where the pair gives nothing.
    """
    rectified = _rectify(lens, *poses, content, shrinkage)
    if rectified is None:
        return None
    virtual, (least, count) = rectified.lens, rectified.range_px
    # Moving the second by the least disparity lets both windows show the same piece of the scene.
    left = _warp(images[0], lens, rectified.turns[0], virtual, 0.0)
    right = _warp(images[1], lens, rectified.turns[1], virtual, float(least))
    # SGBM leaves the leftmost ``count`` columns empty: pad them.
    padded = [
        cv2.copyMakeBorder(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), 0, 0, count, 0, cv2.BORDER_CONSTANT)
        for i in (left, right)
    ]
    block = settings.block_px
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=block,
        P1=8 * 3 * block**2,
        P2=32 * 3 * block**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=settings.uniqueness,
        speckleWindowSize=60,
        speckleRange=1,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    found = matcher.compute(*padded)[:, count:].astype(np.float32) / 16
    total = found + least
    usable = (found >= 0) & (total > 0.5)
    depth = np.where(usable, virtual.focal_px * rectified.baseline_mm / np.where(usable, total, 1), 0)
    depth = inside_volume(depth.astype(np.float32), virtual, rectified.turns[0] @ poses[0].R, poses[0], volume)
    return cropped_map(photo, rectified.turns[0], virtual, depth, left)
