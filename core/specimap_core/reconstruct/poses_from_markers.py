"""Poses from the markers alone: a start from single squares, then one least squares over everything.

Each marker gives two poses per photo (IPPE, Collins and Bartoli 2014). Of the two, the one is taken whose normal
the photo's other markers share; photos and markers are chained from the marker seen most. The focal length is
unknown: several starts, the lowest cost wins.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.bundle_adjust.solver import MarkerScene, SolveInfo, solve
from specimap_core.errors import MarkerGeometryError
from specimap_core.fiducials.observations import Observations, corners_of
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.reconstruct.square_poses import agreeing_poses, largest_consensus, medoid, required, two_poses

FOCAL_STARTS = (0.8, 1.2, 1.8)
"""Starts for an unknown focal length, in longer sides of the photo (measured: one start in three fails)."""
OUTLIER_PX = 6.0
"""Floor of the distance at which a marker in a photo is called foreign to the rest."""

LEAST_AGREEING = 3
"""Photos that must share one layout of markers."""


@dataclass(frozen=True)
class MarkerSolution:
    """Stage 1's answer from markers.

    ``photos`` and ``markers``: the indices and ids that ``scene``'s poses and corners belong to. ``ambiguous``:
    photos posed by a single marker whose two poses fit almost alike, with the other pose. ``foreign``: photos
    that contradict the rest, by their RMS in pixels.
    """

    scene: MarkerScene
    info: SolveInfo
    seen: Observations
    photos: tuple[int, ...]
    markers: tuple[int, ...]
    ambiguous: dict[int, Pose]
    foreign: dict[int, float]
    unconnected: tuple[int, ...]


def solve_from_markers(
    seen: Observations,
    marker_ids: tuple[int, ...],
    size: tuple[int, int],
    *,
    edge_mm: float,
    focal_px: float | None = None,
    start: MarkerSolution | None = None,
) -> MarkerSolution:
    """Pose all photos that show a marker, without calibration.

    Args:
        seen: ``photo`` indexes the caller's photos; ``marker`` indexes ``marker_ids``.
        size: width, height of the photos in pixels.
        focal_px: from EXIF, where there is one; used as a start and a weak prior.
        start: what nearly the same corners were solved to; what it places need not be looked for again.

    Raises:
        MarkerGeometryError: no start leads to a consistent set of cameras.
    """
    longer = max(size)
    focals = [focal_px] if focal_px else [s * longer for s in FOCAL_STARTS]
    lenses = [start.scene.lens] if start else [Intrinsics.centred(*size, focal) for focal in focals]
    limit = max(OUTLIER_PX, 0.004 * longer)
    best = min((_solve_start(seen, marker_ids, lens, edge_mm, focal_px, start) for lens in lenses), key=_rank)
    if best.info.rms_after_px > limit or best.foreign:
        # A layout averaged over two scenes fits neither: find the one that most photos share.
        agreed = [_solve_consensus(seen, marker_ids, lens, edge_mm, focal_px, limit) for lens in lenses]
        best = min([best, *(s for s in agreed if s)], key=lambda s: (s.info.rms_after_px > limit, _rank(s)))
    if best.info.rms_after_px > 2 * limit:
        raise MarkerGeometryError(
            f"The markers do not fit together: {best.info.rms_after_px:.1f} px remain.",
            advice="Photograph one unmoved scene with one camera, each marker once, and print markers undistorted.",
            rms_px=best.info.rms_after_px,
        )
    return best


def _rank(solution: MarkerSolution) -> tuple[int, float]:
    return len(solution.foreign) + len(solution.unconnected), solution.info.cost


def _solve_consensus(
    seen: Observations,
    marker_ids: tuple[int, ...],
    lens: Intrinsics,
    edge_mm: float,
    focal_prior: float | None,
    limit_px: float,
) -> MarkerSolution | None:
    """The solution from the photos that share one layout of markers; None where that leaves too few."""
    picked = agreeing_poses(seen, two_poses(seen.corners_px, lens, edge_mm))
    contradict = largest_consensus(seen, picked, lens, edge_mm, limit_px)
    keep = ~np.isin(seen.photo, list(contradict))
    if not contradict or len(np.unique(seen.photo[keep])) < LEAST_AGREEING:
        return None
    solution = _solve_start(seen.of(keep), marker_ids, lens, edge_mm, focal_prior)
    return replace(solution, foreign={**contradict, **solution.foreign})


def _solve_start(
    seen: Observations,
    marker_ids: tuple[int, ...],
    lens: Intrinsics,
    edge_mm: float,
    focal_prior: float | None,
    start: MarkerSolution | None = None,
) -> MarkerSolution:
    picked = agreeing_poses(seen, two_poses(seen.corners_px, lens, edge_mm))
    poses, squares = _poses_by_index(start, marker_ids) if start else ({}, _most_seen(seen, picked))
    lost = _chain(seen, picked, poses, squares)
    seen = seen.of(np.isin(seen.photo, list(poses)) & np.isin(seen.marker, list(squares)))
    photos, markers = tuple(sorted(poses)), tuple(sorted(squares))
    inner = _reindexed(seen, photos, markers)
    world = tuple(squares[m] for m in markers)
    scene = MarkerScene(lens, tuple(poses[p] for p in photos), corners_of(world, edge_mm), world)
    scene, info = solve(scene, inner, edge_mm=edge_mm, refine_lens=True, focal_prior_px=focal_prior, iterations=60)
    # A photo whose flipped pose fits the solved markers better is turned over; then once more from there.
    scene, ambiguous = _resolve_ambiguities(scene, inner, edge_mm)
    scene, info = solve(scene, inner, edge_mm=edge_mm, refine_lens=True, focal_prior_px=focal_prior, iterations=60)
    residual = np.sqrt((scene.residuals(inner) ** 2).sum(-1).mean(1))
    limit = max(OUTLIER_PX, 5 * float(np.median(residual)))
    foreign: dict[int, float] = {}
    for k in range(len(photos)):
        own = residual[inner.photo == k]
        if np.median(own) > limit:
            foreign[photos[k]] = float(np.median(own))
    keep = np.array([photos[p] not in foreign for p in inner.photo]) & (residual <= limit)
    ambiguous = {photos[p]: pose for p, pose in ambiguous.items()}
    if foreign or not keep.all():
        scene, info, inner, photos, markers = _solve_without(scene, inner, keep, photos, markers, edge_mm, focal_prior)
    ids = tuple(marker_ids[m] for m in markers)
    ambiguous = {p: pose for p, pose in ambiguous.items() if p in photos}
    return MarkerSolution(scene, info, inner, photos, ids, ambiguous, foreign, lost)


def _solve_without(
    scene: MarkerScene,
    seen: Observations,
    keep: np.ndarray[tuple[int, ...], np.dtype[np.bool_]],
    photos: tuple[int, ...],
    markers: tuple[int, ...],
    edge_mm: float,
    focal_prior: float | None,
) -> tuple[MarkerScene, SolveInfo, Observations, tuple[int, ...], tuple[int, ...]]:
    """Solve again without the observations that contradict the rest."""
    rest = seen.of(keep)
    if not len(rest.photo):
        raise MarkerGeometryError(
            "No two photos agree on where the markers are.",
            advice="Photograph one unmoved scene; check that each marker id is used once.",
        )
    used_p, used_m = np.unique(rest.photo), np.unique(rest.marker)
    inner = _reindexed(rest, tuple(used_p), tuple(used_m))
    squares = tuple(scene.squares[m] for m in used_m) if scene.squares else ()
    start = MarkerScene(scene.lens, tuple(scene.poses[p] for p in used_p), corners_of(squares, edge_mm), squares)
    solved, info = solve(start, inner, edge_mm=edge_mm, refine_lens=True, focal_prior_px=focal_prior)
    return solved, info, inner, tuple(photos[p] for p in used_p), tuple(markers[m] for m in used_m)


def _reindexed(seen: Observations, photos: tuple[int, ...], markers: tuple[int, ...]) -> Observations:
    p = {int(v): k for k, v in enumerate(photos)}
    m = {int(v): k for k, v in enumerate(markers)}
    return Observations(
        np.array([p[int(v)] for v in seen.photo]),
        np.array([m[int(v)] for v in seen.marker]),
        seen.corners_px,
        seen.sigma_px,
    )


def _most_seen(seen: Observations, picked: list[Pose | None]) -> dict[int, Pose]:
    """The marker that has a pose in most photos, at the origin. Raises MarkerGeometryError where none has."""
    posed = seen.marker[[pose is not None for pose in picked]]
    if not posed.size:
        raise MarkerGeometryError(
            "No marker shows as a square in any photo: the corners of each lie on a line.",
            advice="Photograph from 30 to 60 degrees above the markers' plane, near enough that their bits show.",
        )
    return {int(np.bincount(posed).argmax()): Pose(np.eye(3), np.zeros(3))}


def _poses_by_index(solution: MarkerSolution, marker_ids: tuple[int, ...]) -> tuple[dict[int, Pose], dict[int, Pose]]:
    """Poses of the photos and of the markers of a solution, the latter by their place in ``marker_ids``."""
    squares = zip(solution.markers, solution.scene.squares or (), strict=True)
    return (
        dict(zip(solution.photos, solution.scene.poses, strict=True)),
        {marker_ids.index(marker): square for marker, square in squares},
    )


def _chain(
    seen: Observations, picked: list[Pose | None], poses: dict[int, Pose], squares: dict[int, Pose]
) -> tuple[int, ...]:
    """Walk from the photos and markers posed so far to all others; averages are left to the least squares.

    Adds to ``poses`` of photos and ``squares`` of markers. Returns the photos that the walk does not reach.
    """
    by_photo: dict[int, list[int]] = defaultdict(list)
    for k, photo in enumerate(seen.photo):
        if picked[k] is not None:
            by_photo[int(photo)].append(k)

    def place_markers(photo: int) -> None:
        for k in by_photo[photo]:
            if int(seen.marker[k]) not in squares:
                squares[int(seen.marker[k])] = poses[photo].inverse() @ required(picked[k])

    for photo in poses:
        place_markers(photo)
    while True:
        reachable = [
            (sum(int(seen.marker[k]) in squares for k in rows), len(rows), photo)
            for photo, rows in by_photo.items()
            if photo not in poses and any(int(seen.marker[k]) in squares for k in rows)
        ]
        if not reachable:
            break
        _, _, photo = max(reachable)
        known = [k for k in by_photo[photo] if int(seen.marker[k]) in squares]
        poses[photo] = medoid([required(picked[k]) @ squares[int(seen.marker[k])].inverse() for k in known])
        place_markers(photo)
    return tuple(sorted(set(by_photo) - set(poses)))


def _resolve_ambiguities(scene: MarkerScene, seen: Observations, edge_mm: float) -> tuple[MarkerScene, dict[int, Pose]]:
    """Give each photo the pose, among those its single squares offer, that fits all it sees best.

    Returns the scene and the photos that show one marker only and whose other pose fits almost as well.
    """
    assert scene.squares is not None
    poses = list(scene.poses)
    ambiguous: dict[int, Pose] = {}
    choices = two_poses(seen.corners_px, scene.lens, edge_mm)
    back = [square.inverse() for square in scene.squares]
    for p in range(len(poses)):
        rows = np.flatnonzero(seen.photo == p)
        mine = seen.of(seen.photo == p)
        options = [poses[p], *(pose @ back[int(seen.marker[k])] for k in rows for pose, _ in choices[k])]
        cam = np.stack([option.apply(scene.corners[mine.marker]) for option in options])
        miss = np.linalg.norm(scene.lens.project(cam) - mine.corners_px, axis=-1).reshape(len(options), -1)
        costs = np.where(np.isfinite(miss).all(1), np.median(miss, axis=1), np.inf)
        best = int(np.argmin(costs))
        if costs[best] < 0.9 * costs[0]:
            poses[p] = options[best]
        if len(mine.marker) == 1 and len(options) > 2:
            away = [
                k
                for k in range(1, len(options))
                if np.trace(options[k].R.T @ poses[p].R) < 2.9 and costs[k] < 4 * costs[best] + 0.3
            ]
            if away:
                ambiguous[p] = options[min(away, key=lambda k: costs[k])]
    return MarkerScene(scene.lens, tuple(poses), scene.corners, scene.squares), ambiguous
