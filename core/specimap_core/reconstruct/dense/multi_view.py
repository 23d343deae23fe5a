"""Depth of all photos: a rough look at what stands in the volume first, then every pair over just that."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from specimap_core.arrays import Bytes, Floats
from specimap_core.errors import DepthNotFoundError
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.reconstruct.dense.pairs import choose_pairs
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.stereo import antialiased, match_pair, shared_share, viewing_angles_deg
from specimap_core.reconstruct.dense.volume import Volume

COARSE_PX = 256
COARSE_PAIRS = 10
LEAST_MAPS = 3
"""Fusion keeps what so many maps show; see ``SurfaceSettings.least_weight``."""
LEAST_MAPS_SHARE = 0.05
"""Of the pairs; with fewer, what a place shows rests on one pair alone."""
LEAST_SHARED = 0.3
"""Of what one photo of a pair shows: below, the pair says little about depth."""
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
        found = match_pair((shrunk[i], shrunk[j]), small, (poses[i], poses[j]), volume, volume.vertices, i, settings)
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
    """Depth maps of all pairs; ``images``: posed photos (H, W, 3), in the order of ``poses``.

    Raises:
        DepthNotFoundError: hardly a pair gives depth; the message says why.
    """
    pairs = choose_pairs(poses, volume.centre, settings)
    if len(pairs) < LEAST_MAPS:
        raise DepthNotFoundError(
            f"{'Hardly any' if pairs else 'No'} two of the {len(poses)} photos look at the markers from directions "
            "4 to 42 degrees apart.",
            advice="Take photos all around, neighbours 10 to 20 degrees apart and about equally far away.",
            photos=len(poses),
        )
    content = find_content(images, lens, poses, volume, pairs, settings, workers)
    shrinkage = settings.shrinkage(lens)
    images = [antialiased(image, shrinkage) for image in images]
    maps: list[DepthMap] = []

    def run(pair: tuple[int, int]) -> DepthMap | None:
        i, j = pair
        return match_pair((images[i], images[j]), lens, (poses[i], poses[j]), volume, content, i, settings, shrinkage)

    with ThreadPoolExecutor(workers) as pool:
        for done, depth_map in enumerate(pool.map(run, pairs), 1):
            if depth_map is not None:
                maps.append(depth_map)
            progress(done / len(pairs))
    if len(maps) < max(LEAST_MAPS, LEAST_MAPS_SHARE * len(pairs)):
        raise _not_found(lens, poses, volume, pairs, len(maps), settings.angle_deg[2])
    return maps


def _not_found(
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    volume: Volume,
    pairs: list[tuple[int, int]],
    found: int,
    widest_deg: float,
) -> DepthNotFoundError:
    """Why hardly a pair gave depth: they do not show the same, look from too far apart, or nothing in them matches."""
    details = {"photos": len(poses), "pairs": len(pairs), "pairs_with_depth": found}
    apart = sum(shared_share(lens, poses[i], poses[j], volume.lattice) < LEAST_SHARED for i, j in pairs)
    if apart > len(pairs) / 2:
        height = float(np.median([p.centre[2] for p in poses]))
        width = float(np.ptp(volume.vertices[:, :2], axis=0).max())
        return DepthNotFoundError(
            f"{apart} of {len(pairs)} pairs of neighbouring photos show too little in common: the cameras stood "
            f"{height:.0f} mm above markers that span {width:.0f} mm.",
            advice="Take the photos from farther away, so that each shows most of the markers with the specimen.",
            **details,
        )
    apart_of = viewing_angles_deg(poses, volume.centre)
    apart_deg = float(np.median([apart_of[i, j] for i, j in pairs]))
    if apart_deg > widest_deg:
        return DepthNotFoundError(
            f"Neighbouring photos look at the markers from directions {apart_deg:.0f} degrees apart: too far for what "
            f"one shows to be found in the other; {found} of {len(pairs)} pairs gave depth.",
            advice="Take 20 or more photos all around, neighbours 10 to 20 degrees apart.",
            **details,
        )
    return DepthNotFoundError(
        f"Hardly anything matches between neighbouring photos: {found} of {len(pairs)} pairs gave depth.",
        advice="Take sharp photos in even light; put the specimen on a patterned surface, and dab off what glistens.",
        **details,
    )
