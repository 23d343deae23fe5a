"""Cubes of other cameras than a frame camera with square pixels: recognised, registered, and what is said of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from specimap_core.errors import RegistrationError, SpecimapError
from specimap_core.geometry.cameras import Intrinsics, View, look_at
from specimap_core.geometry.pushbroom import Axis, ScanView
from specimap_core.register.accuracy import on_plane
from specimap_core.register.camera_fitting import CubeObservations, refit
from specimap_core.register.camera_models import FRAME
from specimap_core.register.cube_camera import CubeCamera, solve_camera
from specimap_core.register.destriping import destriped
from specimap_core.register.model_selection import SelectedCamera, fit_by_corners, select_camera
from specimap_core.register.tile_offsets import TileOffsets
from specimap_core.report.model import Report
from specimap_core.truth.judge import Judged, judge_with_sigma
from tests.support.moved_specimen import CORNERS, LARGER
from tests.support.reruns import Reruns, codes

ROWS, COLS = 256, 320
SHARP_PX = 0.02
NOTHING = np.empty((0, 3))
RAISED = np.random.default_rng(1).uniform([-12, -12, 5], [12, 12, 12], (100, 3))


def unseen(view: View) -> TileOffsets | None:
    """No specimen is found through any camera."""
    del view
    return None


def square_camera(observed: CubeObservations) -> CubeCamera | None:
    try:
        return solve_camera(observed.corners, observed.pixels, observed.sigma_px, ROWS, COLS)
    except RegistrationError:
        return None


def by_corners(view: View, noise_px: float, seed: int, ids: tuple[int, ...] = (0, 1, 2, 3)) -> SelectedCamera:
    """What corners with noise alone say of ``view``."""
    corners = CORNERS[list(ids)].reshape(-1, 3)
    pixels = view.project(corners) + np.random.default_rng(seed).normal(0, noise_px, (len(corners), 2))
    observed = CubeObservations(corners, pixels, np.full(len(corners), max(noise_px, SHARP_PX)))
    return select_camera(observed, fit_by_corners(observed, ROWS, COLS, square_camera(observed)), RAISED, unseen)


def above(aspect: float = 1.0, tilt_mm: float = 8.0) -> View:
    lens = replace(Intrinsics.centred(COLS, ROWS, 1600.0), aspect=aspect)
    return View(lens, look_at(np.array([tilt_mm, -tilt_mm, 400]), np.zeros(3), np.array([0, 1.0, 0])))


# ---- corners alone ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("tilt_mm", [0.0, 8.0, 60.0])
@pytest.mark.parametrize("noise_px", [0.02, 0.5])
def test_square_pixels_are_left_square(noise_px: float, tilt_mm: float) -> None:
    assert {by_corners(above(tilt_mm=tilt_mm), noise_px, seed).model for seed in range(6)} == {FRAME}


@pytest.mark.slow
@pytest.mark.parametrize("aspect", [0.3, 0.7, 0.97, 1.03, 1.4, 3.0])
@pytest.mark.parametrize("ids", [(0, 1, 2, 3), (0, 1, 2), (0, 2)])
def test_the_aspect_shows_in_the_corners(aspect: float, ids: tuple[int, ...]) -> None:
    for seed in range(3):
        choice = by_corners(above(aspect), SHARP_PX, seed, ids)
        assert choice.model is not FRAME
        camera = choice.fit.camera
        assert camera.view.intrinsics.aspect == pytest.approx(aspect, rel=0.01)
        assert not choice.specimen_used
        # Kinds that the corners do not tell apart, and all tilts that they allow, are in what is stated.
        off = (camera.view.project(RAISED) - above(aspect).project(RAISED)) * camera.span_mm
        stated = float(np.hypot(choice.by_corners.camera.lateral_sd_mm(RAISED), choice.ambiguity_mm))
        assert stated > 0.005
        assert float(np.sqrt((off**2).sum(1).mean())) < 3 * stated


def test_pixels_that_nobody_makes_are_refused_with_their_aspect() -> None:
    for aspect in (0.15, 6.0):
        with pytest.raises(RegistrationError, match=f"{aspect:.2f} times as high") as refused:
            by_corners(above(aspect), SHARP_PX, 0)
        assert "0.25 and 4" in refused.value.advice


@pytest.mark.parametrize("axis", ["rows", "columns"])
def test_a_marker_left_out_of_a_scan_is_placed_by_the_others(axis: Axis) -> None:
    frame = above(0.8)
    view = ScanView(frame.intrinsics, frame.cam_from_world, axis, 0.01, 0.0, 400.0)
    flat = CORNERS[:3].reshape(-1, 3)
    away = np.array([1.0, -2.0])
    moved = refit(view, flat, view.project(flat) + away, np.full(12, SHARP_PX))
    left_out = CORNERS[3]
    miss = on_plane(moved, view.project(left_out) + away, left_out[:, 2]) - left_out[:, :2]
    assert np.abs(miss).max() < 0.01


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(
    st.floats(0.1, 8.0),
    st.floats(-0.6, 0.6),
    st.floats(-0.6, 0.6),
    st.floats(0.0, 6.3),
    st.booleans(),
    st.sampled_from([(0, 1, 2, 3), (0, 1, 2), (0, 1), (3,)]),
    st.sampled_from([0.0, 0.02, 3.0]),
)
@example(1 / 3, -0.353034124221959, 1e-44, 0.0, False, (3,), 3.0)  # a scan's camera ends below the markers
def test_whatever_the_corners_show_ends_in_a_camera_or_a_refusal(
    aspect: float, x: float, y: float, turn: float, mirrored: bool, ids: tuple[int, ...], noise_px: float
) -> None:
    lens = replace(Intrinsics.centred(COLS, ROWS, 1600.0), aspect=aspect)
    eye = 400 * np.array([x, y, 1.0])
    view = View(lens, look_at(eye, np.zeros(3), np.array([np.cos(turn), np.sin(turn), 0.0])))
    corners = CORNERS[list(ids)].reshape(-1, 3)
    pixels = view.project(corners) + np.random.default_rng(0).normal(0, noise_px, (len(corners), 2))
    if mirrored:
        pixels[:, 0] = COLS - 1 - pixels[:, 0]
    observed = CubeObservations(corners, pixels, np.full(len(corners), SHARP_PX))
    try:
        by_corners = fit_by_corners(observed, ROWS, COLS, square_camera(observed))
        choice = select_camera(observed, by_corners, NOTHING, unseen)
    except SpecimapError:
        return
    assert np.isfinite(choice.fit.camera.view.project(corners)).all()
    assert np.isfinite([choice.ambiguity_mm, choice.misfit_mm, choice.fit.cost]).all()


# ---- dead columns and lines ---------------------------------------------------------------------------


@pytest.mark.parametrize("value", [0.0, 1e6, np.nan])
def test_dead_columns_and_lines_are_bridged_and_nothing_else(value: float) -> None:
    rng = np.random.default_rng(0)
    rows, cols = np.indices((120, 160))
    smooth = 0.5 + 0.2 * np.sin(cols / 9) * np.cos(rows / 7)
    clean = (smooth + 0.01 * rng.standard_normal(rows.shape)).astype(np.float32)
    clean[20:60, 30:70] = 0.05
    assert (destriped(clean) == clean).all()
    dead = clean.copy()
    dead[:, [0, 80, 81, 82, 159]] = value
    dead[50:53] = value
    bridged = destriped(dead)
    touched = np.zeros(clean.shape, bool)
    touched[:, [0, 80, 81, 82, 159]] = touched[50:53] = True
    assert np.abs(bridged - clean)[touched].max() < 0.6
    assert np.median(np.abs(bridged - clean)[touched]) < 0.05
    assert (bridged[~touched] == clean[~touched]).all()


# ---- whole runs ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Cube:
    """What is changed of the phantom's cube, the kind that it is then of, its aspect and what is said of it."""

    change: dict[str, object]
    model: str
    aspect: float = 1.0
    said: frozenset[str] = frozenset()


NOT_FRAME, NOT_SQUARE = "cube_camera_not_frame", "cube_pixels_not_square"
OURS = {NOT_FRAME, NOT_SQUARE, "cube_camera_unfit", "cube_camera_loose", "specimen_moved"}
CUBES = {
    "square": Cube({}, "frame"),
    "lines of 0.7": Cube({"cube_aspect": 0.7, "cube_rows": 366}, "frame", 0.7, frozenset({NOT_SQUARE})),
    "lines of 1.4": Cube({"cube_aspect": 1.4, "cube_rows": 183}, "frame", 1.4, frozenset({NOT_SQUARE})),
    "scan of rows": Cube({"cube_scan": "rows"}, "scan_rows", 1.0, frozenset({NOT_FRAME})),
    "scan of columns": Cube({"cube_scan": "columns"}, "scan_columns", 1.0, frozenset({NOT_FRAME})),
    "slow scan": Cube(
        {"cube_scan": "rows", "cube_aspect": 1.03, "cube_rows": 249},
        "scan_rows",
        1.03,
        frozenset({NOT_FRAME, NOT_SQUARE}),
    ),
    "scan aslant": Cube({"cube_scan": "rows", "scan_pitch_deg": 10.0}, "scan_rows", 1.0, frozenset({NOT_FRAME})),
}


def run_on(cube: Cube, reruns: Reruns, hidden: tuple[int, ...] = ()) -> tuple[Report, Judged]:
    folder, report = reruns.on(replace(LARGER, **cube.change), hidden)  # type: ignore[arg-type]
    return report, judge_with_sigma(folder / "out", folder)


@pytest.fixture(scope="module")
def plain_mm(reruns: Reruns) -> float:
    """The error with a frame camera of square pixels: the surface's own, most of it."""
    return run_on(CUBES["square"], reruns)[1].errors.median


@pytest.mark.slow
@pytest.mark.parametrize("name", CUBES)
def test_a_cube_is_registered_by_a_camera_of_its_own_kind(reruns: Reruns, plain_mm: float, name: str) -> None:
    cube = CUBES[name]
    report, judged = run_on(cube, reruns)
    assert codes(report) & OURS == cube.said
    assert report.cube_camera.model == cube.model
    assert report.cube_camera.pixel_aspect == pytest.approx(cube.aspect, abs=0.004)
    assert 0.02 < judged.errors.median < plain_mm + 0.04
    assert 0.5 < judged.within(1) < 0.9
    assert judged.within(2) > 0.88
    assert report.methods["camera"].leave_one_marker_out_mm is not None
    assert 0.001 < report.methods["camera"].leave_one_marker_out_mm.median < 0.05


@pytest.mark.slow
def test_two_markers_and_the_specimen_tell_a_scan(reruns: Reruns, plain_mm: float) -> None:
    report, judged = run_on(CUBES["scan of rows"], reruns, (1, 3))
    assert report.marker_ids_in_cube == [0, 2]
    assert codes(report) & OURS <= {NOT_FRAME, "cube_camera_loose"}
    assert 0.02 < judged.errors.median < plain_mm + 0.06
    assert judged.within(2) > 0.88


@pytest.mark.slow
def test_a_specimen_that_moved_in_a_scan_is_noticed(reruns: Reruns) -> None:
    cube = Cube({"cube_scan": "rows", "moved_mm": (1.2, -0.9, 0.0)}, "scan_rows")
    report, judged = run_on(cube, reruns)
    assert codes(report) & OURS >= {NOT_FRAME, "specimen_moved"}
    # Moved by 1.5 mm, and followed.
    assert 0.02 < judged.errors.median < 0.2
    assert judged.within(2) > 0.88


@pytest.mark.slow
def test_a_scan_that_wavers_is_no_motion_and_its_deviations_hold(reruns: Reruns) -> None:
    cube = Cube({"cube_scan": "rows", "scan_wobble_mm": 0.3}, "scan_rows")
    report, judged = run_on(cube, reruns)
    assert "cube_camera_unfit" in codes(report)
    assert "specimen_moved" not in codes(report)
    assert 0.1 < judged.errors.median < 0.5
    assert judged.within(1) > 0.4
    assert judged.within(2) > 0.88


@pytest.mark.slow
def test_corners_of_a_cube_are_those_of_its_camera(reruns: Reruns) -> None:
    report, _ = run_on(CUBES["lines of 0.7"], reruns)
    assert report.cube_corners is not None
    residuals = np.array(report.cube_corners.residuals_px)
    assert 0.0 < np.sqrt((residuals**2).mean()) < 0.1
    assert 0.0 < report.cube_camera.reprojection_rms_px < 0.15
