"""Depth of all photos: a rough look at what stands in the volume first, then every pair over just that."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from specimap.core.geometry import Floats, Intrinsics, Pose
from specimap.core.reconstruct.depth import (
    Bytes,
    DepthMap,
    DepthSettings,
    Volume,
    before_shrinking,
    choose_pairs,
    match_pair,
)

COARSE_PX = 256
COARSE_PAIRS = 10
COARSE_CELLS = 40
"""Cells of the coarse grid along the volume's diagonal."""


def find_content(
    images: list[Bytes],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    volume: Volume,
    pairs: list[tuple[int, int]],
    settings: DepthSettings,
    workers: int,
) -> Floats:
    """Points (N, 3) mm that enclose what stands in the volume: from a few pairs at reduced size.

    A box says little about where tissue is: its upper edge alone, close to a low camera, would widen the search
    fivefold. Cells of a coarse grid that two in five pairs agree on, with their neighbours, are what fine matching
    covers.
    """
    factor = min(1.0, COARSE_PX / max(lens.width, lens.height))
    small = lens.scaled(factor)
    few = pairs[:: max(1, len(pairs) // COARSE_PAIRS)]
    used = sorted({k for pair in few for k in pair})
    size = (small.width, small.height)
    shrunk = {k: np.asarray(cv2.resize(images[k], size, interpolation=cv2.INTER_AREA)) for k in used}

    def run(pair: tuple[int, int]) -> NDArray[np.int64]:
        i, j = pair
        found = match_pair(
            (shrunk[i], shrunk[j]), small, (poses[i], poses[j]), volume, volume.vertices, i, settings
        )
        if found is None:
            return np.zeros((0, 3), np.int64)
        cells = np.floor((found.points(poses[i]) - volume.low) / cell).astype(np.int64)
        kept, count = np.unique(cells, axis=0, return_counts=True)
        return kept[count >= 3]

    cell = float(np.linalg.norm((volume.high - volume.low)[:2])) / COARSE_CELLS
    with ThreadPoolExecutor(workers) as pool:
        votes = np.concatenate(list(pool.map(run, few)))
    floor = volume.vertices.copy()
    floor[:, 2] = np.where(floor[:, 2] == volume.low[2], volume.low[2], 0.0)
    cells, count = np.unique(votes, axis=0, return_counts=True)
    agreed = cells[count >= max(min(3, len(few)), round(0.4 * len(few)))]
    if len(agreed) < 10:
        return volume.vertices
    # False matches float; tissue stands on the tray and is one part with it.
    filled = np.zeros(agreed.max(0) + 1, bool)
    filled[tuple(agreed.T)] = True
    parts, _ = label(filled, np.ones((3, 3, 3)))
    agreed = np.argwhere(parts == np.bincount(parts[filled]).argmax())
    around = np.array([[x, y, z] for x in (-1, 2) for y in (-1, 2) for z in (-1, 2)])
    enclosing = (agreed[:, None] + around).reshape(-1, 3) * cell + volume.low
    return np.concatenate([floor, np.clip(enclosing, volume.low, volume.high)])


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
    """Depth maps of all pairs; ``images``: posed photos (H, W, 3), in the order of ``poses``. None where no two photos
    look from directions that can be matched."""
    pairs = choose_pairs(poses, volume.centre, settings)
    if not pairs:
        return []
    content = find_content(images, lens, poses, volume, pairs, settings, workers)
    shrinkage = settings.shrinkage(lens)
    images = [before_shrinking(image, shrinkage) for image in images]
    maps: list[DepthMap] = []

    def run(pair: tuple[int, int]) -> DepthMap | None:
        i, j = pair
        return match_pair(
            (images[i], images[j]), lens, (poses[i], poses[j]), volume, content, i, settings, shrinkage
        )

    with ThreadPoolExecutor(workers) as pool:
        for done, depth_map in enumerate(pool.map(run, pairs), 1):
            if depth_map is not None:
                maps.append(depth_map)
            progress(done / len(pairs))
    return maps
