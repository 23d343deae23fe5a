"""Dense depth on a CPU: neighbouring photos rectified in pairs, semi-global matching, sub-pixel refinement.

A pair is rectified by a rotation of its own, with x along the baseline, so it does not matter how the phone was
rolled. Matching is OpenCV's StereoSGBM (Hirschmueller 2008); its disparities, which lean toward whole pixels, are
then refined by the variational method of Brox et al. 2004.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap.core.geometry import Floats, Intrinsics, Pose, View

Bytes = NDArray[np.uint8]
Singles = NDArray[np.float32]


@dataclass(frozen=True)
class DepthSettings:
    """Dense matching.

    ``angle_deg``: least, best and widest angle between two photos' directions to the scene. ``wide_angle_deg``:
    the widest angle where a photo has no nearer neighbour. ``pairs_per_photo``: partners of each photo.
    ``block_px``: matching window. ``uniqueness``: per cent by which the best match must win.
    """

    angle_deg: tuple[float, float, float] = (4.0, 14.0, 30.0)
    wide_angle_deg: float = 42.0
    pairs_per_photo: int = 3
    block_px: int = 5
    uniqueness: int = 8
    refine: bool = True


@dataclass(frozen=True)
class Volume:
    """The box in the marker frame, mm, in which a surface is looked for: low (3,), high (3,)."""

    low: Floats
    high: Floats

    @property
    def vertices(self) -> Floats:
        """The eight corners, (8, 3)."""
        return np.array([[x, y, z] for x in (self.low[0], self.high[0]) for y in (self.low[1], self.high[1])
                         for z in (self.low[2], self.high[2])])  # fmt: skip

    @property
    def centre(self) -> Floats:
        """(3,) mm."""
        return (self.low + self.high) / 2


@dataclass(frozen=True)
class DepthMap:
    """Depth of one photo, in a virtual camera at the photo's place.

    ``photo``: index of the posed photo. ``turn`` (3, 3): ``virtual_from_photo`` rotation. ``intrinsics``: of the
    virtual, undistorted camera. ``depth`` (H, W) along z in mm, 0 where unknown. ``weight`` (H, W) in 0..1.
    ``colour`` (H, W, 3) sRGB uint8 seen there.
    """

    photo: int
    turn: Floats
    intrinsics: Intrinsics
    depth: Singles
    weight: Singles
    colour: Bytes

    def view(self, pose: Pose) -> View:
        """The virtual camera, given the photo's (refined) ``cam_from_world``."""
        return View(self.intrinsics, Pose(self.turn @ pose.R, self.turn @ pose.t))


def volume_over(corners: Floats, *, height_share: float = 0.35, below_mm: float = 2.0) -> Volume:
    """The box over the markers' corners (..., 3), as high as ``height_share`` of the layout's diagonal."""
    points = corners.reshape(-1, 3)
    low, high = points.min(0), points.max(0)
    diagonal = float(np.linalg.norm((high - low)[:2]))
    return Volume(
        np.array([low[0], low[1], low[2] - below_mm]),
        np.array([high[0], high[1], high[2] + height_share * diagonal]),
    )


def choose_pairs(poses: tuple[Pose, ...], target: Floats, settings: DepthSettings) -> list[tuple[int, int]]:
    """Ordered pairs (reference, other): for each photo its best neighbours in viewing angle.

    Linear in the number of photos. Where fewer than two neighbours lie within the usual angles (few photos),
    wider ones are taken, since a steep match is better than a hole.
    """
    centres = np.stack([p.centre for p in poses])
    sight = centres - target
    distance = np.linalg.norm(sight, axis=1)
    sight = sight / distance[:, None]
    angle = np.degrees(np.arccos(np.clip(sight @ sight.T, -1, 1)))
    least, best, widest = settings.angle_deg
    pairs = []
    for i in range(len(poses)):
        ratio = np.maximum(distance / distance[i], distance[i] / distance)
        badness = np.abs(np.log(np.maximum(angle[i], 0.1) / best)) + 2 * np.log(ratio)
        near = np.flatnonzero((angle[i] >= least) & (angle[i] <= widest) & (ratio < 1.6))
        if len(near) < 2:
            near = np.flatnonzero(
                (angle[i] >= least) & (angle[i] <= settings.wide_angle_deg) & (ratio < 1.8)
            )
        chosen: list[int] = []
        for j in near[np.argsort(badness[near])]:
            # Partners from different sides see around different corners: skip one close to a chosen one.
            if all(angle[j, k] > 0.6 * best for k in chosen):
                chosen.append(int(j))
            if len(chosen) == settings.pairs_per_photo:
                break
        pairs += [(i, j) for j in chosen]
    return pairs


@dataclass(frozen=True)
class _Rectified:
    lens: Intrinsics
    turns: tuple[Floats, Floats]
    baseline_mm: float
    disparities: tuple[int, int]


def _rectify(lens: Intrinsics, first: Pose, second: Pose, volume: Volume) -> _Rectified | None:
    """Virtual cameras for a pair, cut to where the volume shows; None where the pair cannot be rectified."""
    baseline = second.centre - first.centre
    length = float(np.linalg.norm(baseline))
    forward = first.R[2] + second.R[2]
    x = baseline / length
    z = forward - (forward @ x) * x
    if length < 1e-6 or np.linalg.norm(z) < 0.5:
        return None
    z = z / np.linalg.norm(z)
    R = np.stack([x, np.cross(z, x), z])
    pixels, depths = [], []
    for pose in (first, second):
        cam = (volume.vertices - pose.centre) @ R.T
        if cam[:, 2].min() <= 0.05 * cam[:, 2].max():
            return None
        pixels.append(lens.focal_px * cam[:, :2] / cam[:, 2:])
        depths.append(cam[:, 2])
    # The reference's window; the other shares its rows and origin, so a disparity is a plain difference.
    low, high = pixels[0].min(0), pixels[0].max(0)
    most = 1.3 * np.array([lens.width, lens.height])
    low, high = np.maximum(low, -most), np.minimum(high, most)
    nearest, farthest = float(depths[0].min()), float(depths[0].max())
    d_low = int(np.floor(lens.focal_px * length / farthest)) - 2
    d_high = int(np.ceil(lens.focal_px * length / nearest)) + 2
    count = -(-(d_high - d_low) // 16) * 16
    width, height = (int(v) for v in np.ceil(high - low) + 1)
    if width < 32 or height < 32 or count > 640:
        return None
    virtual = Intrinsics(width, height, lens.focal_px, float(-low[0]), float(-low[1]))
    return _Rectified(virtual, (R @ first.R.T, R @ second.R.T), length, (d_low, count))


def _warp(image: Bytes, lens: Intrinsics, turn: Floats, virtual: Intrinsics, shift: float) -> Bytes:
    matrix = virtual.matrix
    matrix[0, 2] += shift
    maps = cv2.initUndistortRectifyMap(
        lens.matrix, lens.distortion, turn, matrix, (virtual.width, virtual.height), cv2.CV_32FC1
    )
    return np.asarray(cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT))


def match_pair(
    images: tuple[Bytes, Bytes],
    lens: Intrinsics,
    poses: tuple[Pose, Pose],
    volume: Volume,
    photo: int,
    settings: DepthSettings,
) -> DepthMap | None:
    """Depth of the first of two photos (H, W, 3) from both; None where the pair gives nothing."""
    rectified = _rectify(lens, *poses, volume)
    if rectified is None:
        return None
    virtual, (d_low, count) = rectified.lens, rectified.disparities
    # Shifting the second by the least disparity lets both windows show the same piece of the scene.
    left = _warp(images[0], lens, rectified.turns[0], virtual, 0.0)
    right = _warp(images[1], lens, rectified.turns[1], virtual, float(d_low))
    grey = [cv2.cvtColor(i, cv2.COLOR_RGB2GRAY) for i in (left, right)]
    # SGBM leaves the leftmost ``count`` columns empty: pad them.
    padded = [cv2.copyMakeBorder(g, 0, 0, count, 0, cv2.BORDER_CONSTANT) for g in grey]
    block = settings.block_px
    matcher = cv2.StereoSGBM.create(
        minDisparity=0, numDisparities=count, blockSize=block, P1=8 * 3 * block**2, P2=32 * 3 * block**2,
        disp12MaxDiff=1, preFilterCap=31, uniquenessRatio=settings.uniqueness, speckleWindowSize=60,
        speckleRange=1, mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip
    disparity = matcher.compute(*padded)[:, count:].astype(np.float32) / 16
    valid = disparity >= 0
    if valid.sum() < 200:
        return None
    if settings.refine:
        disparity = _refine(grey[0], grey[1], disparity, valid)
    total = disparity + d_low
    depth = np.where(valid & (total > 0.5), virtual.focal_px * rectified.baseline_mm / total, 0)
    depth = _inside(depth.astype(np.float32), virtual, rectified.turns[0] @ poses[0].R, poses[0], volume)
    return _cropped(photo, rectified.turns[0], virtual, depth, left)


def _cropped(
    photo: int, turn: Floats, virtual: Intrinsics, depth: Singles, colour: Bytes
) -> DepthMap | None:
    """The part of the window that holds depth; None where too little does."""
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
    weight = (part > 0).astype(np.float32)
    return DepthMap(photo, turn, lens, part, weight, np.ascontiguousarray(colour[top:bottom, left:right]))


def _refine(left: Bytes, right: Bytes, disparity: Singles, valid: NDArray[np.bool_]) -> Singles:
    """Variational refinement of integer-leaning disparities; a pixel that moved over a pixel keeps its own."""
    filled = disparity.copy()
    filled[~valid] = 0
    # Unknown pixels take the local mean of the known, so that the smoothness term has nothing to fight.
    mask = valid.astype(np.float32)
    for size in (9, 31):
        total = cv2.blur(filled * mask, (size, size))
        count = cv2.blur(mask, (size, size))
        fill = (mask == 0) & (count > 0.02)
        filled[fill] = (total / np.maximum(count, 1e-6))[fill]
        mask = np.maximum(mask, fill.astype(np.float32))
    u, v = np.ascontiguousarray(-filled), np.zeros_like(filled)
    refiner = cv2.VariationalRefinement.create()
    refiner.setAlpha(REFINE_ALPHA)
    refiner.setDelta(REFINE_DELTA)
    refiner.setGamma(REFINE_GAMMA)
    refiner.setFixedPointIterations(REFINE_ITERATIONS)
    u, v = refiner.calcUV(left, right, u, v)
    refined = -u
    off = np.abs(refined - disparity) > 1.0
    return np.where(off, disparity, refined).astype(np.float32)


REFINE_ALPHA, REFINE_DELTA, REFINE_GAMMA, REFINE_ITERATIONS = 20.0, 5.0, 10.0, 5


def _inside(depth: Singles, virtual: Intrinsics, R: Floats, pose: Pose, volume: Volume) -> Singles:
    """Depths whose points lie outside the volume become 0."""
    v, u = np.indices(depth.shape, dtype=np.float32)
    rays = np.stack([(u - virtual.cx) / virtual.focal_px, (v - virtual.cy) / virtual.focal_px,
                     np.ones_like(u)], -1)  # fmt: skip
    points = (rays * depth[..., None]) @ R.astype(np.float32) + pose.centre.astype(np.float32)
    keep = ((points >= volume.low) & (points <= volume.high)).all(-1)
    return np.where(keep, depth, 0).astype(np.float32)


def dense_depth(
    images: list[Bytes],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    volume: Volume,
    settings: DepthSettings,
    *,
    workers: int,
    progress: Callable[[float], None] = lambda share: None,
) -> list[DepthMap]:
    """Depth maps of all pairs; ``images``: posed photos (H, W, 3), in the order of ``poses``."""
    pairs = choose_pairs(poses, volume.centre, settings)
    maps: list[DepthMap] = []

    def run(pair: tuple[int, int]) -> DepthMap | None:
        i, j = pair
        return match_pair((images[i], images[j]), lens, (poses[i], poses[j]), volume, i, settings)

    with ThreadPoolExecutor(workers) as pool:
        for done, depth_map in enumerate(pool.map(run, pairs), 1):
            if depth_map is not None:
                maps.append(depth_map)
            progress(done / len(pairs))
    return maps
