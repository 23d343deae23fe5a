"""The cube's camera from marker corners alone: what they hold, and what they leave open."""

from __future__ import annotations

import numpy as np
import pytest

from specimap_core.geometry.cameras import Intrinsics, View, look_at
from specimap_core.register.camera_models import FOCAL_PRIOR_SD, FOCAL_RANGE
from specimap_core.register.cube_camera import CubeCamera, solve_camera
from tests.support.moved_specimen import CORNERS, VIEW

ROWS, COLS = VIEW.intrinsics.height, VIEW.intrinsics.width
SHARP_PX = 0.02
SEEDS = range(8)


def above(focal_px: float, aside_mm: float = 0.0) -> View:
    """A camera that sees the layout at VIEW's size, with any focal length, from a place off the vertical."""
    eye = np.array([aside_mm, 0.0, focal_px / 4])
    return View(Intrinsics.centred(COLS, ROWS, focal_px), look_at(eye, np.zeros(3), np.array([0, 1.0, 0])))


def solved(view: View, noise_px: float, seed: int) -> CubeCamera:
    flat = CORNERS.reshape(-1, 3)
    pixels = view.project(flat) + np.random.default_rng(seed).normal(0, noise_px, (len(flat), 2))
    return solve_camera(flat, pixels, np.full(len(flat), noise_px), ROWS, COLS)


@pytest.mark.parametrize("focal_px", [800.0, 1600.0, 3200.0])
def test_without_perspective_the_focal_length_is_the_middle_of_the_range(focal_px: float) -> None:
    # Straight down on a plane, every focal length explains the corners exactly: only the prior is left.
    flat, view = CORNERS.reshape(-1, 3), above(focal_px)
    camera = solve_camera(flat, view.project(flat), np.full(len(flat), 0.1), ROWS, COLS)
    assert camera.view.intrinsics.focal_px == pytest.approx(np.sqrt(FOCAL_RANGE[0] * FOCAL_RANGE[1]) * COLS, rel=1e-3)
    assert 0.3 * FOCAL_PRIOR_SD < camera.focal_sd <= FOCAL_PRIOR_SD


@pytest.mark.parametrize("focal_px", [800.0, 3200.0])
def test_where_perspective_shows_the_prior_has_no_say(focal_px: float) -> None:
    cameras = [solved(above(focal_px, 0.15 * focal_px), 0.01, seed) for seed in SEEDS]
    off = np.array([np.log(c.view.intrinsics.focal_px / focal_px) / c.focal_sd for c in cameras])
    assert max(c.focal_sd for c in cameras) < 0.02
    # Within the stated deviation as normal errors are: their root mean square is 1, known to a quarter from eight.
    assert 0.3 < np.sqrt((off**2).mean()) < 2.0


@pytest.mark.slow
@pytest.mark.parametrize(("aside_mm", "noise_px"), [(10.0, SHARP_PX), (150.0, 0.1)])
def test_sideways_deviation_is_that_of_repeated_solutions(aside_mm: float, noise_px: float) -> None:
    view, raised = above(1600.0, aside_mm), np.array([[0.0, 0.0, 10.0]])
    cameras = [solved(view, noise_px, seed) for seed in range(60)]
    off = np.array([(c.view.project(raised) - view.project(raised))[0] * c.pixel_mm for c in cameras])
    stated = float(np.median([c.lateral_sd_mm(raised) for c in cameras]))
    # Sixty draws know a deviation to a tenth; the prior and soft weights make it a little wide.
    assert 0.6 < float(np.sqrt((off**2).sum(1).mean())) / stated < 1.3


def test_from_above_markers_hold_their_plane_and_leave_height_open() -> None:
    camera = solved(above(1600.0, 10.0), SHARP_PX, 0)
    in_plane, raised = camera.lateral_sd_mm(CORNERS.reshape(-1, 3)), camera.lateral_sd_mm(np.array([[0.0, 0.0, 10.0]]))
    assert 0 < in_plane < 0.3 * raised
