"""Fit a camera of any model to marker corners, and to tiles of the specimen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

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
from specimap_core.register.corner_prior import CornerPrior
from specimap_core.register.cube_camera import LEAST_SCATTER, CubeCamera, solve_camera
from specimap_core.register.tile_offsets import TileOffsets

MOTION_SCALES = np.array([0.01] * 3 + [0.1] * 3)
"""Typical change of a turn in rad and a shift in mm."""
MOTION_SD = np.array([0.02, 0.02, 0.1, 3.0, 3.0, 0.2])
"""Standard deviations of a specimen's tilts and turn in rad and of its shift in mm: it is nudged or laid down anew on a
tray, and what a cube hardly shows, a lift, is not made use of."""
NO_MOTION = np.zeros(len(MOTION_SCALES))
SHARED_MM = 0.02 / 2**0.5
"""Standard deviation, along an axis, of the error that all tiles share: seen through the true camera, specimens that
did not move lie 0.00 to 0.01 mm away on own phantoms and 0.02 to 0.03 mm on path-traced ones."""
SHARED = 2
"""Unknowns of that error."""


def moved(points: Floats, motion: Floats, middle: Floats) -> Floats:
    """Points (..., 3) mm turned by the rotation vector ``motion[:3]`` rad about ``middle`` (3,), and shifted by
    ``motion[3:]`` mm."""
    return np.asarray((points - middle) @ rotation_from_vector(motion[:3]).T + middle + motion[3:])


@dataclass(frozen=True)
class TileObservations:
    """Where the specimen shows: ``points`` (T, S, 3) mm of each tile, their mean place ``pixels`` (T, 2) in the cube as
    found, its ``sigma_px`` (2,), and what a pixel spans there, ``mm_per_px`` (2,)."""

    points: Floats
    pixels: Floats
    sigma_px: Floats
    mm_per_px: Floats

    @cached_property
    def middle(self) -> Floats:
        """The middle (3,) of all tiles, mm, about which a motion turns."""
        return np.asarray(self.points.mean((0, 1)))

    @staticmethod
    def of(measured: TileOffsets, sigma_mm: float) -> TileObservations:
        """Take the tiles that have an offset, each axis with a standard deviation of ``sigma_mm``."""
        kept = np.isfinite(measured.offsets[:, 0]) & (measured.weight > 0)
        points = measured.points[kept]
        pixels = measured.view.project(points).mean(1) + measured.offsets[kept] / measured.scale
        mm_per_px = measured.view.mm_per_px(measured.depth_mm)
        return TileObservations(points, pixels, sigma_mm / mm_per_px, mm_per_px)

    def miss(self, view: View, motion: Floats, shared_mm: Floats) -> Floats:
        """By how many standard deviations (T, 2) ``view`` expects it elsewhere, the specimen moved by ``motion`` (6,):
        a rotation vector about the tiles' middle, rad, and a shift, mm. All tiles were measured ``shared_mm`` (2,) away
        from their places, across and down."""
        return self.off(self.shown(view, self.after(motion)), shared_mm)

    def after(self, motion: Floats) -> Floats:
        """The points where the specimen moved by ``motion``."""
        return moved(self.points, motion, self.middle) if motion.any() else self.points

    def shown(self, view: View, points: Floats) -> Floats:
        """Mean place (T, 2) of each tile's ``points`` in the cube."""
        return np.asarray(np.add.reduce(view.project(points), 1) / points.shape[1])

    def off(self, shown: Floats, shared_mm: Floats) -> Floats:
        """What :meth:`miss` gives, of tiles expected at ``shown`` (T, 2)."""
        return np.asarray((shown + shared_mm / self.mm_per_px - self.pixels) / self.sigma_px)


@dataclass(frozen=True)
class CubeObservations:
    """Observations in the cube: ``corners`` (N, 3) mm at ``pixels`` (N, 2) with ``sigma_px`` (N,), and ``tiles``;
    ``covariance`` (3 N, 3 N) mm^2 of the corners' own places, None where they are known."""

    corners: Floats
    pixels: Floats
    sigma_px: Floats
    tiles: TileObservations | None = None
    covariance: Floats | None = None

    def prior_through(self, view: View) -> CornerPrior:
        """The corners as ``view`` sees them, with the errors of their places."""
        return CornerPrior.of(view, self.corners, self.sigma_px, self.covariance)

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

    ``cost``: robust chi squared of the observations and priors; ``motion`` (6,): turn rad and shift mm of the specimen,
    zero where it was taken to have stayed; ``corner_shift`` (N, 3) mm: by how much the cube moves the corners from
    where the photos put them; ``scatter``: root mean square of the corners' residuals in standard deviations;
    ``dof_factor``: root of observations over degrees of freedom, by which fitting makes residuals smaller;
    ``tile_miss`` (T, 2): residuals of the tiles in their standard deviations; ``covariance`` (n, n) of the camera's
    parameters, where it may have moved the specimen's motion, and the error that the tiles share.
    """

    camera: CubeCamera
    observed: CubeObservations
    cost: float
    motion: Floats
    corner_shift: Floats
    scatter: float
    dof_factor: float
    tile_miss: Floats
    covariance: Floats

    def specimen_sd_mm(self, places: Floats) -> float:
        """Lateral standard deviation at ``places`` (N, 3) mm of the specimen, root mean square, by the uncertainty of
        the camera and of a motion together."""
        free, view, tiles = self.camera.model.free, self.camera.view, self.observed.tiles
        if tiles is None or not self.motion.any():
            return self.camera.lateral_sd_mm(places)
        step, middle, columns = 1e-4, tiles.middle, []
        many = free + len(self.motion)
        for e in step * np.eye(many):
            ahead, back = (
                apply_step(view, self.camera.model.step(s * e[:free])).project(moved(places, s * e[free:], middle))
                for s in (1, -1)
            )
            columns.append((ahead - back) / (2 * step))
        J = np.stack(columns, -1) * self.camera.span_mm[:, None]
        return float(np.sqrt(np.maximum(np.einsum("nij,jk,nik->n", J, self.covariance[:many, :many], J), 0).mean()))

    @property
    def tile_mm(self) -> float:
        """Robust root mean square of the tiles' residuals at the specimen, mm; 0 without tiles."""
        if self.observed.tiles is None:
            return 0.0
        miss_mm = self.tile_miss * self.observed.tiles.sigma_px * self.camera.span_mm
        return float(np.sqrt(2) * SIGMA_OF_MAD * np.median(np.abs(miss_mm)))


MOST_STEPS = 40
"""A fit that has not converged by then is to corners that no camera explains, and its numbers mean little."""
REMEMBERED = 32
"""Values of some unknowns for which a fit remembers what they lead to: more than there are unknowns."""
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
    corners, tiles = 2 * len(observed.corners), observed.tiles
    moving = slice(free, free + (len(NO_MOTION) if motion else 0))
    sharing = slice(moving.stop, moving.stop + (0 if tiles is None else SHARED))

    def residual_about(base: View) -> Callable[[Floats], Floats]:
        """Residuals by the unknowns. Numeric derivatives change one unknown at a time, so what only the others enter
        is remembered."""
        prior = observed.prior_through(base)

        @lru_cache(REMEMBERED)
        def through(step: bytes) -> tuple[View, Floats]:
            view = apply_step(base, model.step(np.frombuffer(step)))
            miss = view.project(observed.corners) - observed.pixels
            return view, np.concatenate([prior.whiten(miss), prior_residuals(view)])

        @lru_cache(REMEMBERED)
        def points_after(step: bytes) -> Floats:
            assert tiles is not None
            return tiles.after(np.frombuffer(step) if motion else NO_MOTION)

        @lru_cache(REMEMBERED)
        def shown(step: bytes, moved_by: bytes) -> Floats:
            assert tiles is not None
            return tiles.shown(through(step)[0], points_after(moved_by))

        def residual(x: Floats) -> Floats:
            step, moved_by = x[:free].tobytes(), x[moving].tobytes()
            parts = [through(step)[1]]
            if tiles is not None:
                parts.append(tiles.off(shown(step, moved_by), x[sharing]).ravel())
                parts.append(x[sharing] / SHARED_MM)
            if motion:
                parts.append(x[moving] / MOTION_SD)
            return np.concatenate(parts)

        return residual

    def robust(z: Floats) -> Floats:
        """Soft L1 for corners, which err a little more than stated; Cauchy for tiles, some of which are far off."""
        rho = np.empty((3, len(z)))
        root = np.sqrt(1 + z)
        rho[0], rho[1], rho[2] = 2 * (root - 1), 1 / root, -0.5 / root**3
        first = corners + len(prior_residuals(start))
        far = slice(first, first + (0 if tiles is None else 2 * len(tiles.pixels)))
        rho[0, far], rho[1, far], rho[2, far] = np.log1p(z[far]), 1 / (1 + z[far]), -1 / (1 + z[far]) ** 2
        return rho

    scales = (
        PARAMETER_SCALES[list(model.parameters[:free])],
        MOTION_SCALES[: moving.stop - moving.start],
        np.full(sharing.stop - sharing.start, SHARED_MM),
    )
    x, base = np.zeros(sharing.stop), start
    for _ in range(2):
        answer = least_squares(
            residual_about(base),
            x,
            x_scale=np.concatenate(scales),
            loss=robust,
            max_nfev=MOST_STEPS,
        )
        # Once more from there: steps and covariance are then about the camera that is given.
        base = at_markers(apply_step(base, model.step(answer.x[:free])))
        x = np.append(np.zeros(free), answer.x[free:])
    miss, prior = base.project(observed.corners) - observed.pixels, observed.prior_through(base)
    scatter = float((prior.whiten(miss) ** 2).sum()) / max(corners - free, 1)
    corner_shift = prior.shift(miss)
    miss = miss + prior.seen_shift(corner_shift)
    dof_factor = float(np.sqrt(corners / max(corners - free, 1)))
    whole = np.linalg.pinv(answer.jac.T @ answer.jac) * max(LEAST_SCATTER, scatter)
    covariance = whole[:free, :free]
    camera = CubeCamera(
        base,
        float(np.sqrt((miss**2).sum(-1).mean())),
        float(np.sqrt(covariance[6, 6])) if free > 6 else 0.0,
        covariance,
        model,
    )
    shift = x[moving] if motion else NO_MOTION
    tile_miss = tiles.miss(base, shift, x[sharing]) if tiles is not None else np.empty((0, 2))
    return CameraFit(
        camera,
        observed,
        float(2 * answer.cost),
        shift,
        corner_shift,
        float(np.sqrt(scatter)),
        dof_factor,
        tile_miss,
        whole,
    )
