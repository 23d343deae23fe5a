"""Stage 2: joint adjustment on marker corners; the metric marker frame.

``rigid`` (default): each marker a square of known edge, a robust loss, a refined shared lens. ``free``: as
published, poses and free corner positions, intrinsics fixed, plain sum of squared reprojection errors; the
mean edge then gives the scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.covariance import corner_covariance
from specimap_core.bundle_adjust.solver import MarkerScene, rms_px, solve
from specimap_core.errors import MarkerGeometryError
from specimap_core.fiducials.layout import edge_lengths, marker_frame, rigid_square
from specimap_core.fiducials.observations import Observations, corners_of
from specimap_core.fiducials.triangulation import triangulate
from specimap_core.geometry.cameras import Intrinsics, Pose, fit_similarity

Form = Literal["rigid", "free"]


@dataclass(frozen=True)
class AdjustSettings:
    """``form``: rigid squares or free corners. ``edge_mm``: the known edge of a marker."""

    form: Form = "rigid"
    edge_mm: float = 6.8


@dataclass(frozen=True)
class Adjusted:
    """Stage 2's answer, in the marker frame.

    ``poses``: ``cam_from_world`` of all photos of stage 1; ``corners`` (Q, 4, 3) mm of ``marker_ids`` with
    ``covariance`` (12 Q, 12 Q) mm^2 (marginal; rigid motions of the layout projected out). ``scale``: what stage
    1's lengths were multiplied by. ``rms_before_px``, ``rms_after_px``: reprojection RMS over all corners.
    """

    lens: Intrinsics
    poses: tuple[Pose, ...]
    marker_ids: tuple[int, ...]
    corners: Floats
    covariance: Floats
    scale: float
    rms_before_px: float
    rms_after_px: float
    iterations: int
    observations: int

    @property
    def sigma_corner_mm(self) -> Floats:
        """One standard deviation (Q, 4) of a corner's place in space, mm."""
        return _corner_sd(self.covariance)

    def sigma_layout_mm(self, places: Floats) -> float:
        """One standard deviation, mm, root mean square, of where the layout puts ``places`` (N, 3) mm between corners.

        An error of scale moves a place by as much less as it is nearer to the middle; all else is taken to move it as
        it moves a corner.
        """
        points = self.corners.reshape(-1, 3)
        points = points - points.mean(0)
        size = float(np.linalg.norm(points))
        outward = points.ravel() / size
        keep = np.eye(len(outward)) - np.outer(outward, outward)
        scale_sd = float(np.sqrt(max(outward @ self.covariance @ outward, 0))) / size
        away = float(np.sqrt(((places - self.corners.mean((0, 1))) ** 2).sum(1).mean())) if len(places) else 0.0
        return float(np.hypot(np.median(_corner_sd(keep @ self.covariance @ keep)), scale_sd * away))


def adjust(
    lens: Intrinsics,
    poses: tuple[Pose, ...],
    seen: Observations,
    marker_ids: tuple[int, ...],
    settings: AdjustSettings,
) -> Adjusted:
    """Adjust cameras, given in any frame and scale, on the corners seen.

    ``seen.photo`` indexes ``poses``; ``seen.marker`` indexes ``marker_ids`` (ascending). Poses of photos without
    a marker move along with the rest.

    Raises:
        MarkerGeometryError: no marker is seen by two photos.
    """
    first = triangulate(lens, poses, seen, len(marker_ids))
    known = np.asarray(np.isfinite(first).all(axis=(1, 2)), bool)
    if not known.any():
        raise MarkerGeometryError(
            "No marker is seen by two posed photos.",
            advice="Take more photos in which the same markers show.",
        )
    # A marker that one photo alone shows has no place of its own; it waits for the cube in vain.
    kept = np.flatnonzero(known)
    ids = tuple(marker_ids[m] for m in kept)
    seen = seen.of(known[seen.marker])
    seen = replace(seen, marker=np.searchsorted(kept, seen.marker))
    first = first[kept]
    scale = settings.edge_mm / float(np.median(edge_lengths(first)))
    frame = marker_frame(first, np.stack([p.centre for p in poses]))
    start_poses = tuple(_scaled(p, scale) @ _scaled(frame, scale).inverse() for p in poses)
    start = _scaled(frame, scale).apply(scale * first)
    used = np.unique(seen.photo)
    inner = replace(seen, photo=np.searchsorted(used, seen.photo))
    before = rms_px(MarkerScene(lens, start_poses, start, None).residuals(seen))
    rigid = settings.form == "rigid"
    squares = tuple(rigid_square(c, settings.edge_mm) for c in start) if rigid else None
    scene = MarkerScene(
        lens,
        tuple(start_poses[p] for p in used),
        corners_of(squares, settings.edge_mm) if squares else start,
        squares,
    )
    solved, info = solve(scene, inner, edge_mm=settings.edge_mm, refine_lens=rigid, robust=rigid, growth=rigid)
    if not rigid:
        factor = settings.edge_mm / float(edge_lengths(solved.corners).mean())
        solved = MarkerScene(
            solved.lens, tuple(_scaled(p, factor) for p in solved.poses), solved.corners * factor, None
        )
        scale *= factor
    else:
        factor = 1.0
    final = marker_frame(solved.corners, np.stack([p.centre for p in solved.poses]))
    back = final.inverse()
    refined = {int(p): pose @ back for p, pose in zip(used, solved.poses, strict=True)}
    # Photos without a marker keep their place relative to the corners.
    _, R, t = fit_similarity(factor * start.reshape(-1, 3), final.apply(solved.corners).reshape(-1, 3))
    follow = Pose(R, t).inverse()
    all_poses = tuple(refined.get(k, _scaled(pose, factor) @ follow) for k, pose in enumerate(start_poses))
    corners = final.apply(solved.corners)
    covariance = corner_covariance(solved, info)
    return Adjusted(
        solved.lens,
        all_poses,
        ids,
        corners,
        _in_frame(covariance, final.R),
        scale,
        before,
        info.rms_after_px,
        info.iterations,
        len(inner.photo),
    )


def _corner_sd(covariance: Floats) -> Floats:
    """Standard deviations (Q, 4) of corners of a covariance (12 Q, 12 Q)."""
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance).reshape(-1, 4, 3).sum(-1), 0)))


def _scaled(pose: Pose, factor: float) -> Pose:
    return Pose(pose.R, pose.t * factor)


def _in_frame(covariance: Floats, R: Floats) -> Floats:
    """Rotate a covariance (3 N, 3 N) of N points by R."""
    n = len(covariance) // 3
    blocks = covariance.reshape(n, 3, n, 3)
    return np.asarray(np.einsum("ij,ajbk,lk->aibl", R, blocks, R).reshape(3 * n, 3 * n))
