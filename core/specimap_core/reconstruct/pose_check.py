"""Find photos whose markers contradict their pose, as a pose by features may be wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from specimap_core.bundle_adjust.solver import MarkerScene
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.reconstruct.backend import CornersInPhotos
from specimap_core.reconstruct.poses_from_markers import OUTLIER_PX

OUTLIER_MEDIANS = 5.0
LEAST_LEFT = 3


def outlier_photos(lens: Intrinsics, poses: Mapping[int, Pose], corners: CornersInPhotos) -> dict[int, float]:
    """Photos in which most markers stand far from where the others put them, and how far in pixels.

    ``poses``: ``cam_from_world`` by photo. The worst is taken out first, since it moves the markers that the others are
    judged by.
    """
    left, found = dict(poses), dict[int, float]()
    while len(left) > LEAST_LEFT:
        worst = _worst(lens, left, corners)
        if worst is None:
            break
        found[worst[0]] = worst[1]
        del left[worst[0]]
    return found


def _worst(lens: Intrinsics, poses: Mapping[int, Pose], corners: CornersInPhotos) -> tuple[int, float] | None:
    """The photo that is farthest off, and by how much; None where none is."""
    photos = sorted(poses)
    order = {photo: k for k, photo in enumerate(photos)}
    seen = corners.seen.of(np.isin(corners.seen.photo, photos))
    seen = replace(seen, photo=np.array([order[int(p)] for p in seen.photo], int))
    in_order = tuple(poses[p] for p in photos)
    placed = triangulate(lens, in_order, seen, len(corners.marker_ids))
    known = np.asarray(np.isfinite(placed).all(axis=(1, 2)), bool)
    seen = seen.of(known[seen.marker])
    if not len(seen.photo):
        return None
    off = np.sqrt((MarkerScene(lens, in_order, placed, None).residuals(seen) ** 2).sum(-1).mean(1))
    showing = np.unique(seen.photo)
    medians = np.array([float(np.median(off[seen.photo == p])) for p in showing])
    limit = max(OUTLIER_PX, 0.004 * max(lens.width, lens.height), OUTLIER_MEDIANS * float(np.median(medians)))
    worst = int(medians.argmax())
    return (photos[int(showing[worst])], float(medians[worst])) if medians[worst] > limit else None
