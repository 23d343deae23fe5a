"""Find false markers: texture read as a marker, with an id that no printed marker has."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np

from specimap_core.bundle_adjust.solver import MarkerScene
from specimap_core.fiducials.layout import edge_lengths
from specimap_core.fiducials.observations import Observations
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.reconstruct.backend import CornersInPhotos
from specimap_core.reconstruct.poses_from_markers import OUTLIER_PX, MarkerSolution

LIKE_EDGE = 0.2
"""Relative difference from the markers' edge up to which a square is one of them."""


def misread_ids(corners: CornersInPhotos, solution: MarkerSolution) -> set[int]:
    """Ids that no two photos show as a square of the markers' size at one place.

    Dictionaries of few bits, ARUCO_ORIGINAL above all, read such ids here and there. A marker that was moved is none of
    them: the photos before agree on its place, and those after on another. Photos that the solution does not pose, as
    they wait for features or show another scene, are given the benefit.
    """
    order = {photo: k for k, photo in enumerate(solution.photos)}
    found = set()
    for k, marker in enumerate(corners.marker_ids):
        mine = corners.seen.of(corners.seen.marker == k)
        if all(int(p) in order for p in mine.photo) and not _two_agree(mine, order, solution):
            found.add(marker)
    return found


def _two_agree(mine: Observations, order: dict[int, int], solution: MarkerSolution) -> bool:
    """Whether two sightings of one marker are of one square of the right size."""
    lens, edge = solution.scene.lens, float(edge_lengths(solution.scene.corners).mean())
    poses = [solution.scene.poses[order[int(p)]] for p in mine.photo]
    for i, j in combinations(range(len(poses)), 2):
        pair = Observations(np.arange(2), np.zeros(2, int), mine.corners_px[[i, j]], mine.sigma_px[[i, j]])
        square = triangulate(lens, (poses[i], poses[j]), pair, 1)
        if not np.isfinite(square).all() or abs(edge_lengths(square).mean() / edge - 1) > LIKE_EDGE:
            continue
        off = MarkerScene(lens, (poses[i], poses[j]), square, None).residuals(pair)
        if np.sqrt((off**2).sum(-1).mean()) <= OUTLIER_PX:
            return True
    return False


def without_markers(corners: CornersInPhotos, ids: set[int]) -> CornersInPhotos:
    """The corners without some markers, not solved yet."""
    left = tuple(i for i in corners.marker_ids if i not in ids)
    keep = np.flatnonzero([i in left for i in corners.marker_ids])
    seen = corners.seen.of(np.isin(corners.seen.marker, keep))
    return CornersInPhotos(replace(seen, marker=np.searchsorted(keep, seen.marker)), left)


def start_without_markers(solution: MarkerSolution, ids: set[int]) -> MarkerSolution:
    """A solution to start from where some of its markers are gone; what it says of the corners is not carried on."""
    keep = [k for k, marker in enumerate(solution.markers) if marker not in ids]
    squares = solution.scene.squares
    scene = replace(
        solution.scene,
        corners=solution.scene.corners[keep],
        squares=None if squares is None else tuple(squares[k] for k in keep),
    )
    return replace(solution, scene=scene, markers=tuple(solution.markers[k] for k in keep))
