"""Cross-check depth maps of different photos."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Bytes, Floats, Singles
from specimap_core.geometry.cameras import Pose, View

SEEN_BEHIND = 4.0
"""A depth this many tolerances behind the other photo's is hidden there: that photo has no say."""


def viewing_directions(poses: Sequence[Pose], target: Floats) -> Floats:
    """Unit directions (N, 3) from ``target`` to the cameras."""
    away = np.stack([p.centre for p in poses]) - target
    return np.asarray(away / np.linalg.norm(away, axis=1, keepdims=True))


def nearest_photos(poses: Sequence[Pose], target: Floats, count: int) -> list[list[int]]:
    """For each photo the ``count`` others that look at ``target`` from the nearest directions."""
    towards = viewing_directions(poses, target)
    order = np.argsort(-(towards @ towards.T), axis=1)
    return [[int(j) for j in row if j != i][:count] for i, row in enumerate(order)]


def confirmed(
    depths: Sequence[Singles], views: Sequence[View], others: Sequence[Sequence[int]], tolerance: float, *, workers: int
) -> list[tuple[Bytes, Bytes]]:
    """For each map (H, W), 0 where unknown: in how many of its ``others`` each depth is seen, and confirmed.

    A depth is seen where the other map knows a depth on its ray that does not hide it; it is confirmed where the two
    differ by less than ``tolerance``, a share of the depth. Both (H, W) uint8.
    """

    def one(k: int) -> tuple[Bytes, Bytes]:
        return _confirm(k, depths, views, others[k], tolerance)

    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(one, range(len(depths))))


def share_confirmed(seen: Bytes, agreed: Bytes) -> Floats:
    """The share, above 0 and up to 1, of the photos seeing a depth that confirm it; 1 where none sees it."""
    return np.asarray((1.0 + agreed) / (1.0 + np.maximum(seen, agreed)))


def _confirm(
    k: int, depths: Sequence[Singles], views: Sequence[View], others: Sequence[int], tolerance: float
) -> tuple[Bytes, Bytes]:
    rows, cols = np.nonzero(depths[k])
    view = views[k]
    cam = view.intrinsics.rays(np.stack([cols, rows], -1).astype(float)) * depths[k][rows, cols, None]
    points = view.cam_from_world.inverse().apply(cam).astype(np.float32)
    seen, agreed = (np.zeros(depths[k].shape, np.uint8) for _ in range(2))
    for other in others:
        at, z = _look_up(points, views[other], depths[other].shape)
        known = np.zeros(len(points), np.float32)
        inside = at[:, 0] >= 0
        known[inside] = depths[other][at[inside, 1], at[inside, 0]]
        off = np.where(known > 0, (z - known) / np.maximum(z, 1e-6), np.inf)
        seen[rows, cols] += (known > 0) & (off < SEEN_BEHIND * tolerance)
        agreed[rows, cols] += np.abs(off) < tolerance
    return seen, agreed


def _look_up(points: NDArray[np.float32], view: View, shape: tuple[int, ...]) -> tuple[NDArray[np.int32], Singles]:
    """Nearest pixels (N, 2), -1 where outside, and depths (N,) of points in an undistorted view."""
    pose, lens = view.cam_from_world, view.intrinsics
    cam = points @ pose.R.T.astype(np.float32) + pose.t.astype(np.float32)
    z = cam[:, 2]
    ahead = np.maximum(z, 1e-6)
    u = np.rint(cam[:, 0] * np.float32(lens.focal_px) / ahead + np.float32(lens.cx))
    v = np.rint(cam[:, 1] * np.float32(lens.focal_px) / ahead + np.float32(lens.cy))
    inside = (z > 0) & (u >= 0) & (u < shape[1]) & (v >= 0) & (v < shape[0])
    return np.where(inside[:, None], np.stack([u, v], -1), -1).astype(np.int32), np.asarray(z, np.float32)
