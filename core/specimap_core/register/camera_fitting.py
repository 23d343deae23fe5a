"""A camera of any model fitted to marker corners, and to where tiles of the specimen show."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from specimap_core.geometry.cameras import Floats, View, rotation_from_vector
from specimap_core.geometry.pushbroom import ScanView
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.register.camera_models import STEPS, Model, at_markers, model_of, moved, priors
from specimap_core.register.cube_camera import LEAST_SCATTER, CubeCamera, solve_camera
from specimap_core.register.tile_offsets import Sighting

MOTION_STEPS = np.array([0.1, 0.1, 0.01])
"""What a shift in mm and a turn in rad usually change by."""


@dataclass(frozen=True)
class Tissue:
    """Where the specimen shows: ``points`` (T, S, 3) mm of each tile, their mean place ``pixels`` (T, 2) in the cube as
    found, and its ``sigma_px`` (2,)."""

    points: Floats
    pixels: Floats
    sigma_px: Floats

    @staticmethod
    def of(sighting: Sighting, sigma_mm: float) -> Tissue:
        """Of the tiles that say something."""
        kept = np.isfinite(sighting.offsets[:, 0]) & (sighting.weight > 0)
        points = sighting.points[kept]
        pixels = sighting.view.project(points).mean(1) + sighting.offsets[kept] / sighting.scale
        return Tissue(points, pixels, sigma_mm / sighting.view.mm_per_px(sighting.depth_mm))

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
class Sight:
    """What is seen in the cube: ``corners`` (N, 3) mm at ``pixels`` (N, 2) with ``sigma_px`` (N,), and ``tissue``."""

    corners: Floats
    pixels: Floats
    sigma_px: Floats
    tissue: Tissue | None = None

    def looser(self, factor: float) -> Sight:
        """The same with corners less sure."""
        return replace(self, sigma_px=self.sigma_px * factor)

    def with_looser_tissue(self, factor: float) -> Sight:
        """The same with the specimen's tiles less sure."""
        tissue = self.tissue
        return self if tissue is None else replace(self, tissue=replace(tissue, sigma_px=tissue.sigma_px * factor))


@dataclass(frozen=True)
class Fit:
    """A ``camera`` fitted: ``cost``, chi squared of what is seen and of priors, robust; ``motion`` (3,): shift mm and
    turn rad of the specimen, zero where it was taken to have stayed; ``scatter``: root mean square of the corners'
    residuals in standard deviations, ``spared``: by what fitting made them smaller; ``tile_miss`` (T, 2) of the tiles'
    in theirs."""

    camera: CubeCamera
    sight: Sight
    cost: float
    motion: Floats
    scatter: float
    spared: float
    tile_miss: Floats

    @property
    def tile_mm(self) -> float:
        """How far tiles show from where the camera expects them, sideways, as a robust root mean square; 0 of none."""
        if self.sight.tissue is None:
            return 0.0
        miss_mm = self.tile_miss * self.sight.tissue.sigma_px * self.camera.span_mm
        return float(np.sqrt(2) * SIGMA_OF_MAD * np.median(np.abs(miss_mm)))


POSE = 6
"""How many of a model's numbers say where the camera stands."""


def refit(view: View, corners: Floats, pixels: Floats, sigma_px: Floats) -> View:
    """``view`` moved to where it sees ``corners`` (N, 3) mm best at ``pixels`` (N, 2) with ``sigma_px`` (N,); all else
    stays.

    Raises:
        RegistrationError: no camera above the plane sees the corners there.
    """
    lens = view.intrinsics
    if not isinstance(view, ScanView) and lens.aspect == 1:
        return solve_camera(corners, pixels, sigma_px, lens.height, lens.width, focal_px=lens.focal_px).view
    return fit(view, model_of(view), Sight(corners, pixels, sigma_px), held=POSE).camera.view


def fit(start: View, model: Model, sight: Sight, *, motion: bool = False, held: int | None = None) -> Fit:
    """Fit ``model`` from ``start``; with ``motion`` the specimen may have moved; the first ``held`` of the model's
    numbers are free where given."""
    free = model.free if held is None else held
    many = free + (3 if motion else 0)
    weight = 1 / np.maximum(sight.sigma_px, 1e-3)[:, None]
    corners, tissue = 2 * len(sight.corners), sight.tissue

    def residual(x: Floats, base: View) -> Floats:
        view = moved(base, x[:free])
        parts = [((view.project(sight.corners) - sight.pixels) * weight).ravel(), np.array(priors(view))]
        if tissue is not None:
            parts.append(tissue.miss(view, x[free:] if motion else np.zeros(3)).ravel())
        return np.concatenate(parts)

    def robust(z: Floats) -> Floats:
        """Corners lie off by a little more than said, tiles at times by a lot."""
        rho = np.empty((3, len(z)))
        root = np.sqrt(1 + z)
        rho[0], rho[1], rho[2] = 2 * (root - 1), 1 / root, -0.5 / root**3
        far = slice(corners + len(priors(start)), None)
        rho[0, far], rho[1, far], rho[2, far] = np.log1p(z[far]), 1 / (1 + z[far]), -1 / (1 + z[far]) ** 2
        return rho

    x, base = np.zeros(many), start
    for _ in range(2):
        answer = least_squares(
            residual,
            x,
            args=(base,),
            x_scale=np.append(STEPS[:free], MOTION_STEPS[: many - free]),
            loss=robust,
        )
        # Once more from there: steps and covariance are then about the camera that is given.
        base, x = at_markers(moved(base, answer.x[:free])), np.append(np.zeros(free), answer.x[free:])
    miss = base.project(sight.corners) - sight.pixels
    scatter = float(((miss * weight) ** 2).sum()) / max(corners - free, 1)
    spared = float(np.sqrt(corners / max(corners - free, 1)))
    covariance = (np.linalg.pinv(answer.jac.T @ answer.jac) * max(LEAST_SCATTER, scatter))[:free, :free]
    camera = CubeCamera(
        base,
        float(np.sqrt((miss**2).sum(-1).mean())),
        float(np.sqrt(covariance[6, 6])) if free > 6 else 0.0,
        covariance,
        model,
    )
    shift = x[free:] if motion else np.zeros(3)
    tiles = tissue.miss(base, shift) if tissue is not None else np.empty((0, 2))
    return Fit(camera, sight, float(2 * answer.cost), shift, float(np.sqrt(scatter)), spared, tiles)
