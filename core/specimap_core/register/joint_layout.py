"""The markers' layout by photos and cube together.

A cube shows its markers far more sharply than the layout that the photos give them, which errs in scale by a thousandth
where exposure or blur moves all edges of the photos alike. So the cube joins the adjustment as one more camera:
corners, their covariance and the scale of everything that the photos placed are those that both together give.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import Pose, View, fit_similarity
from specimap_core.register.camera_fitting import CameraFit, CubeObservations, fit
from specimap_core.register.camera_models import Model, apply_step, prior_residuals
from specimap_core.register.corners import CornersInCube
from specimap_core.register.cube_camera import CubeCamera, solve_camera
from specimap_core.register.model_selection import fit_by_corners

STEP = 1e-4
"""Of a camera's parameter, for derivatives by differences."""
LEAST_MARKERS = 3
"""Two markers are too few to give a camera and to correct a layout besides."""


@dataclass(frozen=True)
class JointLayout:
    """``adjusted``: cameras and corners by photos and cube; ``scale``: what they multiplied the photos' lengths by.
    ``square``: the frame camera of square pixels by the corners, None where there is none; ``by_corners``: cameras of
    every kind by the corners."""

    adjusted: Adjusted
    scale: float
    square: CubeCamera | None
    by_corners: Mapping[Model, CameraFit]


def join_cube(seen: CornersInCube, adjusted: Adjusted, rows: int, cols: int) -> JointLayout:
    """Adjust the layout of the photos by the corners ``seen`` in a cube of ``rows`` and ``cols``.

    Raises:
        RegistrationError: no camera sees the corners there.
    """
    flat = seen.flat()
    try:
        square = solve_camera(*flat, rows, cols)
    except RegistrationError:
        square = None
    observed = CubeObservations(*flat, covariance=seen.covariance)
    by_corners = fit_by_corners(observed, rows, cols, square)
    if len(seen.marker_ids) < LEAST_MARKERS or seen.covariance is None:
        return JointLayout(adjusted, 1.0, square, by_corners)
    best = min(by_corners.values(), key=lambda f: f.cost + f.camera.model.penalty)
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
    return JointLayout(joint, scale, square, by_corners)


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
