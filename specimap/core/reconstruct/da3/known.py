"""Places in a photo whose depth is known without the network: on the markers, and where features were triangulated."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import map_coordinates

from specimap.core.acquisition import Photo
from specimap.core.geometry import Floats, Intrinsics, Pose, View
from specimap.core.reconstruct.depth import DepthSettings, Singles, choose_pairs
from specimap.core.reconstruct.features import Features, Sift, triangulate_pair
from specimap.core.solver import Observations

MARKER_STEPS = 6
"""Known places along a marker's edge: about as many on four markers as features on a specimen."""
MARKER_INSET = 0.08
"""Share of the edge left out: the network rounds the card's border."""
FEATURE_PARTNERS = 2


def depths_at(points: Floats, view: View, network: Singles) -> tuple[Floats, Floats, Floats]:
    """Pixels (M, 2), the network's depth and the true one (M,) of those ``points`` (N, 3) mm that lie in the view."""
    cam = view.cam_from_world.apply(points)
    cam = cam[cam[:, 2] > 0]
    at = view.intrinsics.project(cam)
    height, width = network.shape
    inside = (at >= 0).all(1) & (at[:, 0] <= width - 1) & (at[:, 1] <= height - 1)
    found = map_coordinates(network, at[inside, ::-1].T, order=1, mode="nearest")
    return at[inside], np.asarray(found, float), cam[inside, 2]


def on_markers(corners: Floats, seen: Observations, photo: int) -> Floats:
    """Places (N, 3) mm inside the markers that a photo shows; ``corners`` (Q, 4, 3) by ``seen.marker``."""
    steps = np.linspace(MARKER_INSET, 1 - MARKER_INSET, MARKER_STEPS)
    u, v = (g.ravel()[:, None] for g in np.meshgrid(steps, steps))
    weights = np.concatenate([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], 1)
    shown = np.unique(seen.marker[seen.photo == photo])
    return np.asarray(weights @ corners[shown]).reshape(-1, 3)


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
