"""Dense depth on a CPU: neighbouring photos rectified in pairs, semi-global matching.

A pair is rectified by a rotation of its own, with x along the baseline, so it does not matter how the phone was
rolled. Matching is OpenCV's StereoSGBM (Hirschmueller 2008), over the disparities of what stands in the volume.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap.core.geometry import Floats, Intrinsics, Pose, View
from specimap.core.reconstruct.volume import Singles, Volume, inside_volume, lattice_over

MOST_DISPARITIES = 512
OWN_BLUR_PX = 0.5
NEAREST_SHARE = 0.05
"""Of the farthest depth: what is nearer, or behind, a camera does not see sharply."""
LEAST_SHOWN = 4
"""Points of a box that two photos must share."""

Bytes = NDArray[np.uint8]
Device = Literal["auto", "cpu", "gpu"]


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


def before_shrinking(image: Bytes, factor: float) -> Bytes:
    """The image (H, W, 3) without what it could not hold at ``factor`` of its size, which would alias."""
    if factor >= 1:
        return image
    # An image's own blur is about half its pixel; shrunk it must be half of the larger one.
    return np.asarray(cv2.GaussianBlur(image, (0, 0), OWN_BLUR_PX * float(np.sqrt(1 / factor**2 - 1))), np.uint8)


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


def sight_angles(poses: tuple[Pose, ...], target: Floats) -> Floats:
    """Degrees (P, P) between the directions from which photos look at ``target`` (3,)."""
    sight = np.stack([p.centre for p in poses]) - target
    sight = sight / np.linalg.norm(sight, axis=1)[:, None]
    return np.asarray(np.degrees(np.arccos(np.clip(sight @ sight.T, -1, 1))))


def choose_pairs(poses: tuple[Pose, ...], target: Floats, settings: DepthSettings) -> list[tuple[int, int]]:
    """Ordered pairs (reference, other): for each photo its best neighbours in viewing angle.

    Linear in the number of photos. Where fewer than two neighbours lie within the usual angles (few photos),
    wider ones are taken, since a steep match is better than a hole.
    """
    distance = np.linalg.norm(np.stack([p.centre for p in poses]) - target, axis=1)
    angle = sight_angles(poses, target)
    least, best, widest = settings.angle_deg
    pairs = []
    partners = settings.pairs_per_photo - (len(poses) >= settings.many_photos)
    for i in range(len(poses)):
        ratio = np.maximum(distance / distance[i], distance[i] / distance)
        badness = np.abs(np.log(np.maximum(angle[i], 0.1) / best)) + 2 * np.log(ratio)
        near = np.flatnonzero((angle[i] >= least) & (angle[i] <= widest) & (ratio < 1.6))
        if len(near) < 2:
            near = np.flatnonzero((angle[i] >= least) & (angle[i] <= settings.wide_angle_deg) & (ratio < 1.8))
        chosen: list[int] = []
        for j in near[np.argsort(badness[near])]:
            # Partners from different sides see around different corners: skip one close to a chosen one.
            if all(angle[j, k] > 0.6 * best for k in chosen):
                chosen.append(int(j))
            if len(chosen) >= max(partners, 1):
                break
        pairs += [(i, j) for j in chosen]
    return pairs


@dataclass(frozen=True)
class _Rectified:
    """``range_px``: least disparity and how many are searched."""

    lens: Intrinsics
    turns: tuple[Floats, Floats]
    baseline_mm: float
    range_px: tuple[int, int]


def _shown(points: Floats, lens: Intrinsics, pose: Pose) -> NDArray[np.bool_]:
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
        cam = (box[_shown(box, lens, first) & _shown(box, lens, second)] - first.centre) @ R.T
        farthest = float(cam[:, 2].max(initial=0))
        nearest = focal_px * length / (MOST_DISPARITIES - 32 + focal_px * length / max(farthest, 1e-9))
        cam = cam[cam[:, 2] > max(nearest, NEAREST_SHARE * farthest)]
    if len(cam) < LEAST_SHOWN:
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
    seen = _shown(content, lens, first)
    return float((_shown(content, lens, second) & seen).sum() / max(int(seen.sum()), 1))


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
