"""Places in a photo whose depth is known without the network: features that were triangulated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.geometry.triangulation import triangulate_pair
from specimap_core.photos.reading import Photo
from specimap_core.reconstruct.dense.pairs import choose_pairs
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.features.base import Features
from specimap_core.reconstruct.features.sift import Sift

FEATURE_PARTNERS = 2


def placed_features(
    photos: list[Photo],
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    target: Floats,
    *,
    workers: int,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Floats]:
    """For each posed photo the places (N, 3) mm of its features that match a neighbour's."""
    sift = Sift(workers)
    features: list[Features] = []
    for one in sift.extract(photos):
        features.append(one)
        progress(0.7 * len(features) / len(photos))
    places: list[list[Floats]] = [[] for _ in photos]
    pairs = choose_pairs(poses, target, DepthSettings(pairs_per_photo=FEATURE_PARTNERS))
    matches = sift.match([(features[i], features[j]) for i, j in pairs])
    for done, ((i, j), matched) in enumerate(zip(pairs, matches, strict=True), 1):
        if len(matched):
            xy = features[i].xy[matched[:, 0]], features[j].xy[matched[:, 1]]
            points, good = triangulate_pair(lens, (poses[i], poses[j]), xy)
            places[i].append(points[good])
            places[j].append(points[good])
        progress(0.7 + 0.3 * done / len(pairs))
    return [np.concatenate([np.zeros((0, 3)), *found]) for found in places]
