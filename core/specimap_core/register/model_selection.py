"""Select the camera model of a cube by the markers' corners and the specimen between them.

Corners in one plane show a push-broom much as a frame camera, and a slower scan much as a camera that looks aslant.
What differs is how far raised tiles leans, and to which side. So every kind is fitted to corners and tiles of the
specimen together, once with a specimen that stayed and once with one that moved, and the simplest is taken unless
another explains clearly more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import RegistrationError
from specimap_core.geometry.cameras import View
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.register.camera_fitting import CameraFit, CubeObservations, TileObservations, fit
from specimap_core.register.camera_models import (
    ASPECT,
    ASPECT_RANGE,
    FRAME,
    SCANS,
    Model,
    PlaneAffinity,
    in_square_pixels,
    no_camera_above,
)
from specimap_core.register.cube_camera import CubeCamera, solve_camera
from specimap_core.register.tile_offsets import TileOffsets

FOCAL_START = 5.0
"""Of a scan's camera, in widths of the cube."""
MOTION_PENALTY = 20.0
"""Chi squared that a specimen that moved must gain over one that stayed."""
TILE_MM, LEAST_TILE_MM = 0.1, 0.03
"""Standard deviation of a tile's place at first, and the least that is believed."""
SHARED_TILE_ERROR = 2.0
"""Factor on a tile's standard deviation where it measures a camera, not where models are compared: several tiles share
an error of the surface, which their scatter does not show."""
LEAST_TILES = 5
ROUNDS = 3
MISFIT_BETWEEN_CORNERS = 1.5
"""Misfit between markers over that at them, where no camera fits."""
MISFIT, MISFIT_MM = 3.0, 0.05
"""Corners that lie so much farther than they should from where the best camera sees them, and farther than this, fit
no camera."""
CONVERGED_MM = 0.02
"""Rounds end when the specimen's expected place changes by less."""
NOT_RULED_OUT = 9.0
"""A kind that explains less by no more than this, in chi squared, is not ruled out."""
IN_DOUBT = 3.0
"""A frame camera of square pixels is in doubt where another explains more by this: numbers that it lacks explain one or
two by chance."""

MeasureOffsets = Callable[[View], TileOffsets | None]


@dataclass(frozen=True)
class SelectedCamera:
    """The ``model`` selected and its ``fit``; ``by_corners``: the same fitted to the corners alone; ``moved``: the
    specimen lies elsewhere; ``tile_offsets``: the last that were measured, through whichever camera; ``ambiguity_mm``:
    lateral distance between where the models that are not ruled out put the specimen, weighted by their likelihood."""

    model: Model
    fit: CameraFit
    by_corners: CameraFit
    moved: bool
    tile_offsets: TileOffsets | None
    ambiguity_mm: float

    @property
    def misfit_mm(self) -> float:
        """Residual of the best camera, where the corners contradict it by more than they may, else 0."""
        camera = self.by_corners.camera
        corners_mm = camera.rms_px * camera.pixel_mm * self.by_corners.dof_factor
        if self.by_corners.scatter < MISFIT or corners_mm < MISFIT_MM:
            return 0.0
        # Corners say nothing of what the scan did between them.
        return max(corners_mm * MISFIT_BETWEEN_CORNERS, self.fit.tile_mm)

    @property
    def specimen_used(self) -> bool:
        """Whether tiles of the specimen took part in the fit."""
        return len(self.fit.tile_miss) > 0


def fit_by_corners(
    observed: CubeObservations, rows: int, cols: int, square: CubeCamera | None
) -> dict[Model, CameraFit]:
    """Fit each kind of camera to the corners in a cube of ``rows`` and ``cols``.

    ``square``: the frame camera of square pixels solved on the corners, if there is one.

    Raises:
        RegistrationError: no kind of camera sees the corners there.
    """
    starts = _starts(observed, rows, cols, square)
    return {model: fitted for (model, _), fitted in _fits(starts, observed, (False,)).items()}


def select_camera(
    observed: CubeObservations, by_corners: Mapping[Model, CameraFit], places: Floats, measure: MeasureOffsets
) -> SelectedCamera:
    """Select among all kinds of camera fitted ``by_corners``.

    ``places`` (N, 3) mm of the specimen's surface; ``measure``: measures the tiles' offsets through a camera.
    """
    # Corners err together with the layout: what the best kind leaves of them is how far they can be trusted.
    observed = observed.with_inflated_corner_sigma(max(1.0, min(f.scatter for f in by_corners.values())))
    now = _fits({model: f.camera.view for model, f in by_corners.items()}, observed, (False,))
    best = _cheapest(now)
    seen: TileOffsets | None = None
    for _ in range(ROUNDS):
        through = now[best].camera.view
        found = _first_offsets(
            measure, [through, *(f.camera.view for f in now.values())] if seen is None else [through]
        )
        if found is None:
            break
        seen = found
        now = _fit_all({m: now[m, s].camera.view for m, s in now if not s}, observed, seen)
        best = _cheapest(now)
        if not len(places) or _apart_mm(now[best].camera, through, places) < CONVERGED_MM:
            break
    model, moved = best
    taken = now[best]
    if taken.observed.tiles is not None:
        taken = fit(taken.camera.view, model, taken.observed.with_inflated_tile_sigma(_shared(taken)), motion=moved)
    return SelectedCamera(model, taken, by_corners[model], moved, seen, _ambiguity_mm(now, best, places))


def _starts(observed: CubeObservations, rows: int, cols: int, square: CubeCamera | None) -> dict[Model, View]:
    flat = PlaneAffinity.of(observed.corners, observed.pixels)
    low, high = ASPECT_RANGE
    if not low < flat.aspect < high:
        raise RegistrationError(
            f"A pixel of the cube is {flat.aspect:.2f} times as high as it is wide, by its markers.",
            advice=f"Give the cube with pixels between {low:g} and {high:g} times as high as wide: record it at "
            "another speed, or bin its rows or columns.",
            aspect=round(flat.aspect, 3),
        )
    starts: dict[Model, View] = {} if square is None else {FRAME: square.view}
    pixels = in_square_pixels(observed.pixels, flat.aspect, rows)
    try:
        even = solve_camera(observed.corners, pixels, observed.sigma_px, rows, cols).view
        starts[ASPECT] = replace(even, intrinsics=replace(even.intrinsics, aspect=flat.aspect))
    except RegistrationError:
        pass
    for model in SCANS:
        assert model.scan is not None
        starts[model] = flat.scan(model.scan, rows, cols, FOCAL_START * max(rows, cols))
    return starts


def _first_offsets(measure: MeasureOffsets, views: Sequence[View]) -> TileOffsets | None:
    """The offsets measured through the first of ``views`` that has enough of them."""
    for view in views:
        found = measure(view)
        if found is not None and (np.isfinite(found.offsets[:, 0]) & (found.weight > 0)).sum() >= LEAST_TILES:
            return found
    return None


def _fits(
    views: dict[Model, View], observed: CubeObservations, motions: Sequence[bool]
) -> dict[tuple[Model, bool], CameraFit]:
    """Fit each model from its view, with a specimen that stayed or moved; those that end in no camera are left out.

    Raises:
        RegistrationError: all do.
    """
    fits = {}
    for model, view in views.items():
        for moved in motions:
            with suppress(RegistrationError):
                fits[model, moved] = fit(view, model, observed, motion=moved)
    if not fits:
        raise no_camera_above()
    return fits


def _fit_all(
    views: dict[Model, View], observed: CubeObservations, seen: TileOffsets
) -> dict[tuple[Model, bool], CameraFit]:
    """Fit every model to corners and tiles, with a specimen that stayed and with one that moved."""
    sigma_mm, fits = TILE_MM, {}
    for _ in range(2):
        whole = replace(observed, tiles=TileObservations.of(seen, sigma_mm))
        fits = _fits(views, whole, (False, True))
        closest = min(fits.values(), key=lambda f: f.cost)
        sigma_mm = max(LEAST_TILE_MM, SIGMA_OF_MAD * float(np.median(np.abs(closest.tile_miss))) * sigma_mm)
    return fits


def fit_tiles(camera: CubeCamera, observed: CubeObservations, seen: TileOffsets, *, moved: bool) -> CameraFit | None:
    """Fit a camera, of the model that it has, to corners and tiles as a camera is measured; None where none fits."""
    sigma_mm, view = TILE_MM, camera.view
    tiles = TileObservations.of(seen, sigma_mm)
    if len(tiles.pixels) < LEAST_TILES:
        return None
    try:
        for _ in range(2):
            whole = replace(observed, tiles=TileObservations.of(seen, sigma_mm))
            fitted = fit(view, camera.model, whole, motion=moved)
            sigma_mm = max(LEAST_TILE_MM, SIGMA_OF_MAD * float(np.median(np.abs(fitted.tile_miss))) * sigma_mm)
        return fit(view, camera.model, whole.with_inflated_tile_sigma(_shared(fitted)), motion=moved)
    except RegistrationError:
        return None


def _shared(fitted: CameraFit) -> float:
    """By how much more than stated a tile errs where it measures a camera."""
    scatter = SIGMA_OF_MAD * float(np.median(np.abs(fitted.tile_miss)))
    return max(1.0, SHARED_TILE_ERROR * scatter)


def _penalised(choice: tuple[Model, bool], fitted: CameraFit) -> float:
    return fitted.cost + choice[0].penalty + MOTION_PENALTY * choice[1]


def _cheapest(fits: dict[tuple[Model, bool], CameraFit]) -> tuple[Model, bool]:
    return min(fits, key=lambda k: _penalised(k, fits[k]))


def _ambiguity_mm(fits: dict[tuple[Model, bool], CameraFit], best: tuple[Model, bool], places: Floats) -> float:
    """Lateral distance between where the models that are not ruled out put the specimen, root mean square."""
    if not len(places):
        return 0.0
    variance = 0.0
    # A frame camera of square pixels is what cubes without a sign of anything else were recorded with.
    least = -NOT_RULED_OUT if best[0] is not FRAME else IN_DOUBT if len(fits[best].tile_miss) else np.inf
    for key, other in fits.items():
        ahead = fits[best].cost - other.cost
        if key[0] is best[0] or key[1] != best[1] or ahead < least:
            continue
        share = 1 / (1 + np.exp(np.clip(-ahead / 2, -30, 30)))
        variance = max(variance, share * _apart_mm(fits[best].camera, other.camera.view, places) ** 2)
    return float(np.sqrt(variance))


def _apart_mm(camera: CubeCamera, view: View, places: Floats) -> float:
    """How far apart two cameras see ``places`` (N, 3), root mean square."""
    miss = (camera.view.project(places) - view.project(places)) * camera.span_mm
    return float(np.sqrt((miss**2).sum(1).mean()))
