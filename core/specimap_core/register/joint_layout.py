"""The markers' layout by photos and cube together.

A cube shows its markers far more sharply than the layout that the photos give them, which errs in scale by a thousandth
where exposure or blur moves all edges of the photos alike. So the cube joins the adjustment as one more camera:
corners, their covariance and the scale of everything that the photos placed are those that both together give.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import Pose, View, fit_similarity
from specimap_core.notices import Notice
from specimap_core.register.camera_fitting import CameraFit, CubeObservations, fit
from specimap_core.register.camera_models import FRAME, Model, apply_step, prior_residuals
from specimap_core.register.corners import CornersInCube
from specimap_core.register.cube_camera import solve_camera
from specimap_core.register.model_selection import fit_by_corners

STEP = 1e-4
"""Of a camera's parameter, for derivatives by differences."""
LEAST_MARKERS = 3
"""Two markers are too few to give a camera and to correct a layout besides."""
MOVED = 3.0
"""A marker moved where the corners' scatter exceeds this many standard deviations, and falls by as much without it."""
LEAST_MOVED_MM = 0.05
"""A marker that is off by less is not called moved: corners of a blurred cube err by so much."""


@dataclass(frozen=True)
class JointLayout:
    """``adjusted``: cameras and corners by photos and cube; ``scale``: what they multiplied the photos' lengths by.

    ``seen``: the corners in the cube, without those of a marker that moved, which ``moved_mm`` names with the distance;
    ``by_corners``: cameras of every kind by the corners.
    """

    adjusted: Adjusted
    scale: float
    seen: CornersInCube
    by_corners: Mapping[Model, CameraFit]
    moved_mm: Mapping[int, float]

    def warnings(self) -> list[Notice]:
        """Warnings for the report."""
        return [
            Notice(
                "marker_moved",
                f"Marker {i} lies {mm:.1f} mm from where the photos show it: it was moved before the cube was"
                " recorded, or is covered in part. The cube's camera was solved without it.",
            )
            for i, mm in self.moved_mm.items()
        ]


def join_cube(seen: CornersInCube, adjusted: Adjusted, rows: int, cols: int) -> JointLayout:
    """Adjust the layout of the photos by the corners ``seen`` in a cube of ``rows`` and ``cols``.

    Raises:
        RegistrationError: no camera sees the corners there.
    """
    by_corners = _by_corners(seen, rows, cols)
    best = _best(by_corners)
    moved_mm: dict[int, float] = {}
    without = _without_moved(seen, best, rows, cols)
    if without is not None:
        moved, by_corners = without
        best = _best(by_corners)
        moved_mm = {seen.marker_ids[moved]: _off_mm(seen, moved, best)}
        seen = seen.of(np.arange(len(seen.marker_ids)) != moved)
    if len(seen.marker_ids) < LEAST_MARKERS or seen.covariance is None:
        return JointLayout(adjusted, 1.0, seen, by_corners, moved_mm)
    flat, observed = seen.flat(), best.observed
    # Corners that no camera explains say as much less of the layout.
    best = fit(best.camera.view, best.camera.model, observed.with_inflated_corner_sigma(max(1.0, best.scatter)))
    at = [adjusted.marker_ids.index(i) for i in seen.marker_ids]
    columns = (12 * np.array(at)[:, None] + np.arange(12)).ravel()
    of = adjusted.covariance[:, columns]
    view, prior = best.camera.view, best.observed.prior_through(best.camera.view)
    shift = prior.shift(view.project(flat[0]) - flat[1], of)
    corners = adjusted.corners + shift.reshape(adjusted.corners.shape)
    by_camera, weight = _camera_derivatives(view, best.camera.model, flat[0])
    covariance = prior.reduced(adjusted.covariance, of, by_camera, weight)
    scale, _, _ = fit_similarity(adjusted.corners.reshape(-1, 3), corners.reshape(-1, 3), with_scale=True)
    poses = tuple(Pose(p.R, p.t * scale) for p in adjusted.poses)
    joint = replace(adjusted, poses=poses, corners=corners, covariance=covariance, scale=adjusted.scale * scale)
    return JointLayout(joint, scale, seen, by_corners, moved_mm)


def _by_corners(seen: CornersInCube, rows: int, cols: int) -> dict[Model, CameraFit]:
    flat = seen.flat()
    try:
        square = solve_camera(*flat, rows, cols)
    except RegistrationError:
        square = None
    return fit_by_corners(CubeObservations(*flat, covariance=seen.covariance), rows, cols, square)


def _best(by_corners: Mapping[Model, CameraFit]) -> CameraFit:
    return min(by_corners.values(), key=lambda f: f.cost + f.camera.model.penalty)


def _without_moved(
    seen: CornersInCube, best: CameraFit, rows: int, cols: int
) -> tuple[int, dict[Model, CameraFit]] | None:
    """The one marker without which all others fit a camera, and the cameras that they fit; None where there is none."""
    count = len(seen.marker_ids)
    if count <= LEAST_MARKERS or best.scatter < MOVED:
        return None
    found = []
    for marker in range(count):
        others = seen.of(np.arange(count) != marker)
        with suppress(RegistrationError):
            # Three markers fit a scan of any step and skew: one that wavered would seem to have moved the fourth.
            square = solve_camera(*others.flat(), rows, cols)
            observed = CubeObservations(*others.flat(), covariance=others.covariance)
            found.append((fit(square.view, FRAME, observed), marker, others))
    if not found:
        return None
    fitted, marker, others = min(found, key=lambda f: f[0].scatter)
    if fitted.scatter > best.scatter / MOVED or _off_mm(seen, marker, fitted) < LEAST_MOVED_MM:
        return None
    fits = _by_corners(others, rows, cols)
    return (marker, fits) if _best(fits).camera.model is FRAME else None


def _off_mm(seen: CornersInCube, marker: int, fitted: CameraFit) -> float:
    """How far a marker shows from where a camera fitted to the others expects it, mm."""
    camera = fitted.camera
    miss = (camera.view.project(seen.corners[marker]) - seen.corners_px[marker]).mean(0)
    return float(np.linalg.norm(miss * camera.span_mm))


def _camera_derivatives(view: View, model: Model, corners: Floats) -> tuple[Floats, Floats]:
    """Derivatives (2 N, P) of the pixels of ``corners`` (N, 3) by the camera's parameters, and the weight (P, P) of the
    priors of these."""
    pixels, priors = [], []
    for step in map(model.step, STEP * np.eye(model.free)):
        ahead, back = apply_step(view, step), apply_step(view, -step)
        pixels.append((ahead.project(corners) - back.project(corners)).ravel() / (2 * STEP))
        priors.append((np.array(prior_residuals(ahead)) - np.array(prior_residuals(back))) / (2 * STEP))
    J = np.array(priors).T
    return np.array(pixels).T, J.T @ J
