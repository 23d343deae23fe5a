"""Poses from single squares: two each, of which the photo's other markers choose one; and the largest consensus."""

from __future__ import annotations

import cv2
import numpy as np

from specimap_core.arrays import Floats
from specimap_core.fiducials.observations import Observations, corners_of, square_corners
from specimap_core.geometry.cameras import Intrinsics, Pose, rotation_from_vector

REFERENCES = 8
"""Photos whose own layout of markers is tried as the one that the others are judged by."""


def two_poses(corners_px: Floats, lens: Intrinsics, edge_mm: float) -> list[list[tuple[Pose, float]]]:
    """The two poses ``cam_from_marker`` of each square with corners (M, 4, 2), with their RMS in pixels, best first;
    none of one whose corners lie on a line."""
    square, found = square_corners(edge_mm), []
    for corners in corners_px:
        _, rvecs, tvecs, errors = cv2.solvePnPGeneric(
            square, corners.reshape(4, 1, 2), lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        # Four corners on a line or in a point have no pose, for which OpenCV gives None.
        answers = () if errors is None else zip(rvecs, tvecs, errors.ravel(), strict=True)
        found.append([(r.ravel(), t.ravel(), float(e)) for r, t, e in answers])
    turns = iter(rotation_from_vector(np.array([r for poses in found for r, _, _ in poses]).reshape(-1, 3)))
    options = [[(Pose(next(turns), t), e) for _, t, e in poses] for poses in found]
    finite = [[(p, e) for p, e in poses if np.isfinite(p.R).all() and np.isfinite(p.t).all()] for poses in options]
    return [sorted(poses, key=lambda pair: pair[1]) for poses in finite]


def agreeing_poses(seen: Observations, choices: list[list[tuple[Pose, float]]]) -> list[Pose | None]:
    """Per observation the pose whose normal the photo's other markers share; alone, the better fitting one."""
    picked: list[Pose | None] = [None] * len(choices)
    for photo in np.unique(seen.photo):
        rows = [k for k in np.flatnonzero(seen.photo == photo) if choices[k]]
        if not rows:
            continue
        options = [option for k in rows for option in choices[k]]
        starts = np.cumsum([0, *(len(choices[k]) for k in rows[:-1])])
        normals = np.stack([pose.R[:, 2] for pose, _ in options])
        misfit = 1 - normals @ normals.T
        totals = np.minimum.reduceat(misfit, starts, axis=1).sum(1)
        # One marker alone leaves a tie, which the fit decides.
        leader = int(np.argmin(totals + 1e-3 * np.array([e for _, e in options])))
        for k, start in zip(rows, starts, strict=True):
            mine = misfit[leader, start : start + len(choices[k])]
            picked[k] = choices[k][int(np.argmin(mine))][0]
    return picked


def required(pose: Pose | None) -> Pose:
    """A pose that is known to be there."""
    assert pose is not None
    return pose


def medoid(candidates: list[Pose]) -> Pose:
    """The pose that lies closest to all the others."""
    centres = np.stack([c.centre for c in candidates])
    turns = np.stack([c.R for c in candidates])
    far = np.linalg.norm(centres[:, None] - centres[None], axis=-1) / (1e-9 + np.linalg.norm(centres, axis=-1).mean())
    cosine = (np.einsum("aij,bij->ab", turns, turns) - 1) / 2
    return candidates[int((far + 1 - cosine).sum(1).argmin())]


def largest_consensus(
    seen: Observations, picked: list[Pose | None], lens: Intrinsics, edge_mm: float, limit_px: float
) -> dict[int, float]:
    """Photos that contradict the layout of markers that most photos share, with their misfit in pixels.

    A photo that shows several markers gives a layout of its own. The others are posed on it, and the layout with
    which most agree to ``limit_px`` wins (Fischler and Bolles 1981). A photo that shares a single marker with it
    cannot contradict it.
    """
    rows: dict[int, list[int]] = {int(p): [] for p in np.unique(seen.photo)}
    for k, pose in enumerate(picked):
        if pose is not None:
            rows[int(seen.photo[k])].append(k)
    best: tuple[int, dict[int, float]] = (-1, {})
    # Stable order: most markers first, then by number.
    for reference in sorted(rows, key=lambda p: (-len(rows[p]), p))[:REFERENCES]:
        layout = {int(seen.marker[k]): required(picked[k]) for k in rows[reference]}
        agree, contradict = 0, {}
        for photo, mine in rows.items():
            shared = [k for k in mine if int(seen.marker[k]) in layout]
            if len(shared) < 2:
                continue
            squares = tuple(layout[int(seen.marker[k])] for k in shared)
            own = medoid([required(picked[k]) @ s.inverse() for k, s in zip(shared, squares, strict=True)])
            miss = lens.project(own.apply(corners_of(squares, edge_mm))) - seen.corners_px[shared]
            misfit = float(np.median(np.sqrt((miss**2).sum(-1))))
            agree += misfit <= limit_px
            if not misfit <= limit_px:
                contradict[photo] = misfit
        if agree > best[0]:
            best = agree, contradict
    return best[1]
