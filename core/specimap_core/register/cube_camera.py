"""The cube's camera from marker corners alone: pose and unknown focal length, without calibration.

Cards need not be coplanar: each start is a general PnP (SQPNP, Terzakis and Lourakis 2020) for a given focal length;
pose and focal length are then refined together. Nearly coplanar corners leave the focal length 10-20 % loose, which the
distance makes good: what remains is a few hundredths of a millimetre at the height of a specimen. With few or blurred
markers it is more, and :mod:`specimap_core.register.camera_refinement` looks at the specimen.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import least_squares

from specimap_core.arrays import Floats
from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import Intrinsics, Pose, View, rotation_from_vector
from specimap_core.geometry.pushbroom import ScanView
from specimap_core.register.camera_models import FOCAL_PRIOR_SD, FOCAL_RANGE, FRAME, Model, apply_step

FOCAL_STARTS = 24
LEAST_SCATTER = 0.5
"""Corners fit together better than they lie, by chance and since their errors share parts: their variance is not taken
for less than this share of what their standard deviations state."""


@dataclass(frozen=True)
class CubeCamera:
    """The solved camera: ``view``; RMS corner distance ``rms_px``; ``focal_sd``: one standard deviation of the
    logarithm of the focal length, as the corners determine it; ``covariance`` (n, n) of the ``model``'s parameters,
    rotation, translation and log focal length first (:func:`specimap_core.register.camera_models.apply_step`)."""

    view: View
    rms_px: float
    focal_sd: float
    covariance: Floats
    model: Model = FRAME

    def lateral_sd_mm(self, points: Floats) -> float:
        """Lateral standard deviation at ``points`` (N, 3) mm, root mean square: the camera's covariance propagated to
        where the cube shows them."""
        step = 1e-4
        J = np.stack(
            [
                (apply_step(self.view, e).project(points) - apply_step(self.view, -e).project(points)) / (2 * step)
                for e in map(self.model.step, step * np.eye(len(self.covariance)))
            ],
            -1,
        )
        J = J * self.span_mm[:, None]
        variance = np.einsum("nij,jk,nik->n", J, self.covariance, J)
        return float(np.sqrt(np.maximum(variance, 0).mean()))

    @property
    def focal_px(self) -> float:
        """Focal length in pixels along a line of the cube: of a push-broom camera, where it sees in perspective."""
        view = self.view
        return float(view.intrinsics.focals_px[1 - view.along if isinstance(view, ScanView) else 0])

    @property
    def span_mm(self) -> Floats:
        """What a pixel spans at the marker plane, across and down, (2,)."""
        return self.view.mm_per_px(float(self.view.cam_from_world.centre[2]))

    @property
    def pixel_mm(self) -> float:
        """What a pixel spans at the marker plane."""
        return float(np.sqrt(self.span_mm.prod()))


def solve_camera(
    corners: Floats,
    corners_px: Floats,
    sigma_px: Floats,
    rows: int,
    cols: int,
    *,
    focal_px: float | None = None,
) -> CubeCamera:
    """Solve the camera that sees ``corners`` (N, 3) mm at ``corners_px`` (N, 2); ``sigma_px`` (N,).

    With ``focal_px`` the focal length is held, else it is an unknown.

    Raises:
        RegistrationError: no camera above the plane sees the corners there.
    """
    starts = [focal_px] if focal_px else list(np.geomspace(*FOCAL_RANGE, FOCAL_STARTS) * max(rows, cols))
    best: tuple[float, Pose, float] | None = None
    for focal in starts:
        lens = Intrinsics.centred(cols, rows, focal)
        try:
            ok, rvec, tvec = cv2.solvePnP(corners, corners_px[:, None], lens.matrix, None, flags=cv2.SOLVEPNP_SQPNP)
        except cv2.error:  # it asserts where no camera of this kind comes near
            continue
        if not ok or not np.isfinite(tvec).all():
            continue
        pose = Pose(rotation_from_vector(rvec.ravel()), tvec.ravel())
        if pose.centre[2] <= 0 or pose.apply(corners)[:, 2].min() <= 0:
            continue
        miss = View(lens, pose).project(corners) - corners_px
        cost = float((miss**2).sum())
        if best is None or cost < best[0]:
            best = cost, pose, focal
    if best is None:
        raise RegistrationError(
            "No camera above the markers sees them as the cube does.",
            advice="Check that cube and photos show the same, unmoved markers.",
        )
    lens = Intrinsics.centred(cols, rows, best[2])
    first = _refine(corners, corners_px, sigma_px, lens, best[1], focal_px is None).view
    # Once more from there: steps and covariance are then about the camera that is given.
    return _refine(corners, corners_px, sigma_px, first.intrinsics, first.cam_from_world, focal_px is None)


def _refine(
    corners: Floats,
    corners_px: Floats,
    sigma_px: Floats,
    lens: Intrinsics,
    pose: Pose,
    free_focal: bool,
) -> CubeCamera:
    start = View(lens, pose)
    weight = 1 / np.maximum(sigma_px, 1e-3)[:, None]
    usual = float(np.sqrt(FOCAL_RANGE[0] * FOCAL_RANGE[1])) * max(lens.width, lens.height)
    off = float(np.log(lens.focal_px / usual))

    def unpack(x: Floats) -> View:
        return apply_step(start, x if free_focal else np.append(x[:6], 0.0))

    def residual(x: Floats) -> Floats:
        view = unpack(x)
        miss = (view.project(corners) - corners_px) * weight
        # The distance follows the focal length, which the prior keeps from running to infinity.
        rest = [(off + x[6]) / FOCAL_PRIOR_SD if free_focal else x[6] / 1e-3]
        return np.append(miss.ravel(), rest)

    answer = least_squares(residual, np.zeros(7), x_scale=np.array([1e-3] * 3 + [1.0] * 3 + [0.1]), loss="soft_l1")
    view = unpack(answer.x)
    miss = view.project(corners) - corners_px
    rms = float(np.sqrt((miss**2).sum(-1).mean()))
    scatter = float(((miss * weight) ** 2).sum()) / max(2 * len(corners) - 7, 1)
    covariance = np.linalg.pinv(answer.jac.T @ answer.jac) * max(LEAST_SCATTER, scatter)
    return CubeCamera(view, rms, float(np.sqrt(covariance[6, 6])), covariance)
