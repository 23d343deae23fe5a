"""The report's figures of accuracy at the markers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.errors import SpecimapError
from specimap_core.geometry.cameras import View
from specimap_core.register.camera_fitting import refit
from specimap_core.register.corners import CornersInCube
from specimap_core.register.figures import LeaveOneOut, MethodFigures, Quartiles, Spread
from specimap_core.register.placement import fit_homography
from specimap_core.render.orthographic import Grid
from specimap_core.surface.raycast import RayCaster


def spread(values: Floats) -> Spread:
    """Mean, standard deviation and count."""
    return Spread(mean=float(values.mean()), std=float(values.std()), n=values.size)


def quartiles(values: Floats) -> Quartiles:
    """Median and quartiles of the finite values."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return Quartiles(median=float("nan"), q1=float("nan"), q3=float("nan"), n=0)
    q1, median, q3 = np.percentile(finite, [25, 50, 75])
    return Quartiles(median=float(median), q1=float(q1), q3=float(q3), n=finite.size)


def on_plane(view: View, pixels: Floats, heights: Floats) -> Floats:
    """Where the rays of pixels (N, 2) meet the horizontal planes at ``heights`` (N,) mm: x, y (N, 2)."""
    directions = view.world_rays(pixels)
    origins = view.origins(pixels)
    reach = (heights - origins[..., 2]) / directions[:, 2]
    return np.asarray(origins[..., :2] + reach[:, None] * directions[:, :2])


def camera_figures(seen: CornersInCube, view: View, caster: RayCaster) -> MethodFigures:
    """Figures of the camera method."""
    corners, pixels, _ = seen.flat()
    flat = np.linalg.norm(on_plane(view, pixels, corners[:, 2]) - corners[:, :2], axis=1)
    hits = caster.cast(view.origins(pixels), view.world_rays(pixels))
    deep = np.linalg.norm(hits.xyz - corners, axis=1)

    def fit(keep: NDArray[np.bool_]) -> Callable[[Floats, Floats], Floats]:
        # Only where the camera stands: as few as two markers would have to give all else.
        held = refit(view, *seen.flat(keep))
        return lambda px, z: on_plane(held, px, z)

    return MethodFigures(
        corner_2d_mm=spread(flat), corner_3d_mm=quartiles(deep), leave_one_marker_out_mm=leave_one_out(seen, fit)
    )


def homography_figures(seen: CornersInCube, coarse: Grid, fine: Grid, ransac_px: float) -> MethodFigures:
    """Figures of the published method."""

    def fit(keep: NDArray[np.bool_] | None) -> Callable[[Floats, Floats], Floats]:
        corners, pixels, _ = seen.flat(keep)
        H = fit_homography(corners, pixels, coarse, ransac_px).H

        def place(px: Floats, _: Floats) -> Floats:
            mapped = np.c_[px, np.ones(len(px))] @ H.T
            return np.asarray(mapped[:, :2] / mapped[:, 2:] * coarse.cell_mm + [coarse.x_min, coarse.y_min])

        return place

    corners, pixels, _ = seen.flat()
    placed = fit(None)(pixels, corners[:, 2])
    flat = np.linalg.norm(placed - corners[:, :2], axis=1)
    cell = np.round(fine.pixel_of(placed)).astype(int)
    inside = ((cell >= 0) & (cell < [fine.xyz.shape[1], fine.xyz.shape[0]])).all(1)
    deep = np.full(len(corners), np.nan)
    # The surface's height at the place; x and y are the place itself.
    height = fine.xyz[cell[inside, 1], cell[inside, 0], 2]
    deep[inside] = np.linalg.norm(np.c_[placed[inside], height] - corners[inside], axis=1)
    return MethodFigures(
        corner_2d_mm=spread(flat), corner_3d_mm=quartiles(deep), leave_one_marker_out_mm=leave_one_out(seen, fit)
    )


def leave_one_out(
    seen: CornersInCube, fit: Callable[[NDArray[np.bool_]], Callable[[Floats, Floats], Floats]]
) -> LeaveOneOut | None:
    """Fit without each marker in turn and measure on it; None with fewer than three markers."""
    count = len(seen.marker_ids)
    if count < 3:
        return None
    errors: dict[str, Floats] = {}
    for m, marker_id in enumerate(seen.marker_ids):
        keep = np.arange(count) != m
        try:
            place = fit(keep)
        except SpecimapError:
            continue
        miss = place(seen.corners_px[m], seen.corners[m][:, 2]) - seen.corners[m][:, :2]
        errors[str(marker_id)] = np.linalg.norm(miss, axis=1)
    if not errors:
        return None
    together = np.concatenate(list(errors.values()))
    return LeaveOneOut(
        median=float(np.median(together)),
        maximum=float(together.max()),
        per_marker={k: float(v.mean()) for k, v in errors.items()},
    )
