"""Fit a camera of any model to marker corners, and to tiles of the specimen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View, rotation_from_vector
from specimap_core.geometry.pushbroom import ScanView
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.register.camera_models import (
    PARAMETER_SCALES,
    Model,
    apply_step,
    at_markers,
    model_of,
    prior_residuals,
)
from specimap_core.register.cube_camera import LEAST_SCATTER, CubeCamera, solve_camera
from specimap_core.register.tile_offsets import TileOffsets

MOTION_SCALES = np.array([0.1, 0.1, 0.01])
"""Typical change of a shift in mm and a turn in rad."""


@dataclass(frozen=True)
class TileObservations:
    """Where the specimen shows: ``points`` (T, S, 3) mm of each tile, their mean place ``pixels`` (T, 2) in the cube as
    found, and its ``sigma_px`` (2,)."""

    points: Floats
    pixels: Floats
    sigma_px: Floats

    @staticmethod
    def of(measured: TileOffsets, sigma_mm: float) -> TileObservations:
        """Take the tiles that have an offset, each axis with a standard deviation of ``sigma_mm``."""
        kept = np.isfinite(measured.offsets[:, 0]) & (measured.weight > 0)
        points = measured.points[kept]
        pixels = measured.view.project(points).mean(1) + measured.offsets[kept] / measured.scale
        return TileObservations(points, pixels, sigma_mm / measured.view.mm_per_px(measured.depth_mm))

    def miss(self, view: View, motion: Floats) -> Floats:
        """By how many standard deviations (T, 2) ``view`` expects it elsewhere, the specimen shifted by ``motion[:2]``
        mm and turned by ``motion[2]`` rad."""
        points = self.points
        if motion.any():
            middle = points.mean((0, 1))
            R = rotation_from_vector(np.array([0.0, 0.0, motion[2]]))
            points = (points - middle) @ R.T + middle + [motion[0], motion[1], 0.0]
        return np.asarray((view.project(points).mean(1) - self.pixels) / self.sigma_px)


@dataclass(frozen=True)
class CubeObservations:
    """Observations in the cube: ``corners`` (N, 3) mm at ``pixels`` (N, 2) with ``sigma_px`` (N,), and ``tiles``."""

    corners: Floats
    pixels: Floats
    sigma_px: Floats
    tiles: TileObservations | None = None

    def with_inflated_corner_sigma(self, factor: float) -> CubeObservations:
        """The same with the corners' standard deviations ``factor`` times as large."""
        return replace(self, sigma_px=self.sigma_px * factor)

    def with_inflated_tile_sigma(self, factor: float) -> CubeObservations:
        """The same with the tiles' standard deviations ``factor`` times as large."""
        tiles = self.tiles
        return self if tiles is None else replace(self, tiles=replace(tiles, sigma_px=tiles.sigma_px * factor))


@dataclass(frozen=True)
class CameraFit:
    """A ``camera`` fitted to what was ``observed``.

    ``cost``: robust chi squared of the observations and priors; ``motion`` (3,): shift mm and turn rad of the specimen,
    zero where it was taken to have stayed; ``scatter``: root mean square of the corners' residuals in standard
    deviations; ``dof_factor``: root of observations over degrees of freedom, by which fitting makes residuals smaller;
    ``tile_miss`` (T, 2): residuals of the tiles in their standard deviations.
    """

    camera: CubeCamera
    observed: CubeObservations
    cost: float
    motion: Floats
    scatter: float
    dof_factor: float
    tile_miss: Floats

    @property
    def tile_mm(self) -> float:
        """Robust root mean square of the tiles' residuals at the specimen, mm; 0 without tiles."""
        if self.observed.tiles is None:
            return 0.0
        miss_mm = self.tile_miss * self.observed.tiles.sigma_px * self.camera.span_mm
        return float(np.sqrt(2) * SIGMA_OF_MAD * np.median(np.abs(miss_mm)))


POSE_PARAMETERS = 6
"""Number of a model's parameters, from the first, that are its pose."""


def refit(view: View, corners: Floats, pixels: Floats, sigma_px: Floats) -> View:
    """Fit the pose of ``view`` alone to ``corners`` (N, 3) mm at ``pixels`` (N, 2) with ``sigma_px`` (N,).

    Raises:
        RegistrationError: no camera above the plane sees the corners there.
    """
    lens = view.intrinsics
    if not isinstance(view, ScanView) and lens.aspect == 1:
        return solve_camera(corners, pixels, sigma_px, lens.height, lens.width, focal_px=lens.focal_px).view
    return fit(view, model_of(view), CubeObservations(corners, pixels, sigma_px), free=POSE_PARAMETERS).camera.view


def fit(
    start: View, model: Model, observed: CubeObservations, *, motion: bool = False, free: int | None = None
) -> CameraFit:
    """Fit ``model`` from ``start``; with ``motion`` the specimen may have moved. ``free``: how many of the model's
    parameters are free, from the first; all by default.

    Raises:
        RegistrationError: the fit ends with a scan's camera below the markers.
    """
    free = model.free if free is None else free
    many = free + (3 if motion else 0)
    weight = 1 / np.maximum(observed.sigma_px, 1e-3)[:, None]
    corners, tiles = 2 * len(observed.corners), observed.tiles

    def residual(x: Floats, base: View) -> Floats:
        view = apply_step(base, x[:free])
        parts = [((view.project(observed.corners) - observed.pixels) * weight).ravel(), np.array(prior_residuals(view))]
        if tiles is not None:
            parts.append(tiles.miss(view, x[free:] if motion else np.zeros(3)).ravel())
        return np.concatenate(parts)

    def robust(z: Floats) -> Floats:
        """Soft L1 for corners, which err a little more than stated; Cauchy for tiles, some of which are far off."""
        rho = np.empty((3, len(z)))
        root = np.sqrt(1 + z)
        rho[0], rho[1], rho[2] = 2 * (root - 1), 1 / root, -0.5 / root**3
        far = slice(corners + len(prior_residuals(start)), None)
        rho[0, far], rho[1, far], rho[2, far] = np.log1p(z[far]), 1 / (1 + z[far]), -1 / (1 + z[far]) ** 2
        return rho

    x, base = np.zeros(many), start
    for _ in range(2):
        answer = least_squares(
            residual,
            x,
            args=(base,),
            x_scale=np.append(PARAMETER_SCALES[:free], MOTION_SCALES[: many - free]),
            loss=robust,
        )
        # Once more from there: steps and covariance are then about the camera that is given.
        base, x = at_markers(apply_step(base, answer.x[:free])), np.append(np.zeros(free), answer.x[free:])
    miss = base.project(observed.corners) - observed.pixels
    scatter = float(((miss * weight) ** 2).sum()) / max(corners - free, 1)
    dof_factor = float(np.sqrt(corners / max(corners - free, 1)))
    covariance = (np.linalg.pinv(answer.jac.T @ answer.jac) * max(LEAST_SCATTER, scatter))[:free, :free]
    camera = CubeCamera(
        base,
        float(np.sqrt((miss**2).sum(-1).mean())),
        float(np.sqrt(covariance[6, 6])) if free > 6 else 0.0,
        covariance,
        model,
    )
    shift = x[free:] if motion else np.zeros(3)
    tile_miss = tiles.miss(base, shift) if tiles is not None else np.empty((0, 2))
    return CameraFit(camera, observed, float(2 * answer.cost), shift, float(np.sqrt(scatter)), dof_factor, tile_miss)
