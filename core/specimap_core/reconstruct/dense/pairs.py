"""Choose the pairs of photos for dense stereo."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Pose
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.stereo import viewing_angles_deg


def choose_pairs(poses: tuple[Pose, ...], target: Floats, settings: DepthSettings) -> list[tuple[int, int]]:
    """Ordered pairs (reference, other): for each photo its best neighbours in viewing angle.

    Linear in the number of photos. Where fewer than two neighbours lie within the usual angles (few photos),
    wider ones are taken, since a steep match is better than a hole.
    """
    distance = np.linalg.norm(np.stack([p.centre for p in poses]) - target, axis=1)
    angle = viewing_angles_deg(poses, target)
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
