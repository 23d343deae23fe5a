"""The push-broom camera: where it sees a place, whence, and that phantoms are seen so."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from specimap_core.errors import SettingsError
from specimap_core.geometry.cameras import Intrinsics, Pose, View, look_at, rotation_from_vector
from specimap_core.geometry.pushbroom import Axis, ScanView, WobblyScan
from specimap_core.register.camera_models import (
    PARAMETER_SCALES,
    PARAMETERS,
    SCANS,
    PlaneAffinity,
    apply_step,
    at_markers,
)
from specimap_core.truth.truth_file import save_truth
from specimap_validation.phantom import Phantom, PhantomSettings, load_truth
from specimap_validation.phantom.views import hsi_view
from tests.support.scenes import SMALL

POINTS = np.random.default_rng(0).uniform([-25, -25, 0], [25, 25, 14], (200, 3))
AXES: tuple[Axis, ...] = ("rows", "columns")


def scan(axis: Axis, skew: float = 0.03, climb: float = 0.05) -> ScanView:
    lens = replace(Intrinsics.centred(320, 256, 1500.0), aspect=0.8)
    pose = look_at(np.array([12.0, -20, 390]), np.array([1.0, 2, 0]), np.array([0.2, 1.0, 0]))
    return ScanView(lens, pose, axis, skew, climb, 400.0)


@pytest.mark.parametrize("axis", AXES)
def test_a_ray_meets_the_place_that_its_pixel_shows(axis: Axis) -> None:
    view = scan(axis)
    pixels = view.project(POINTS)
    away = POINTS - view.origins(pixels)
    along = (away * view.world_rays(pixels)).sum(1)
    assert along.min() > 100
    assert np.linalg.norm(away - along[:, None] * view.world_rays(pixels), axis=1).max() < 1e-9
    assert view.eyes(POINTS) == pytest.approx(view.origins(pixels))
    assert np.linalg.norm(view.world_rays(pixels), axis=1) == pytest.approx(1)


@pytest.mark.parametrize("axis", AXES)
def test_height_shows_along_the_line_alone(axis: Axis) -> None:
    lens = Intrinsics.centred(320, 256, 1500.0)
    view = ScanView(lens, Pose(np.diag([1.0, -1, -1]), np.array([0, 0, 400.0])), axis, depth_mm=400.0)
    low, high = (view.project(np.array([[20.0, 15.0, z]]))[0] for z in (0.0, 10.0))
    frame = View(lens, view.cam_from_world)
    s = view.along
    assert high[s] == pytest.approx(low[s])
    assert high[1 - s] == pytest.approx(frame.project(np.array([20.0, 15.0, 10.0]))[1 - s])
    assert low == pytest.approx(frame.project(np.array([20.0, 15.0, 0.0])))
    assert view.mm_per_px(390.0)[s] == pytest.approx(400 / 1500)
    assert view.mm_per_px(390.0)[1 - s] == pytest.approx(390 / 1500)


FRAME = View(scan("rows").intrinsics, scan("rows").cam_from_world)


@pytest.mark.parametrize("view", [scan("rows"), scan("columns"), FRAME])
def test_a_resized_image_and_a_moved_world_show_the_same(view: View) -> None:
    pixels = view.project(POINTS)
    resized = view.scaled(0.5, 1.25).project(POINTS)
    assert resized == pytest.approx((pixels + 0.5) * [0.5, 1.25] - 0.5)
    motion = Pose(rotation_from_vector(np.array([0.1, -0.2, 0.7])), np.array([5.0, -3, 2]))
    assert view.after(motion).project(motion.inverse().apply(POINTS)) == pytest.approx(pixels)


@pytest.mark.parametrize("axis", AXES)
def test_the_first_ten_numbers_are_those_of_a_scan(axis: Axis) -> None:
    view = scan(axis)
    steps = (np.diag(PARAMETER_SCALES) * 1e-3)[list(SCANS[0].parameters)]
    J = np.stack([(apply_step(view, step).project(POINTS) - view.project(POINTS)).ravel() for step in steps], 1)
    assert J.shape[1] == PARAMETERS - 1
    singular = np.linalg.svd(J / np.linalg.norm(J, axis=0), compute_uv=False)
    # None is another's, or nothing: places at several heights tell all of them apart.
    assert singular.min() > 1e-4
    again = at_markers(apply_step(view, np.array([0.01, -0.02, 0.03, 1, 2, 5, 0.1, 0.05, 0.01, 0.01])))
    assert isinstance(again, ScanView)
    assert again.depth_mm == again.cam_from_world.t[2]
    assert at_markers(again).project(POINTS) == pytest.approx(again.project(POINTS))


@pytest.mark.parametrize("model", SCANS)
def test_a_scan_starts_where_it_sees_the_plane_as_shown(model: object) -> None:
    assert model in SCANS
    axis = SCANS[SCANS.index(model)].scan
    assert axis is not None
    true = scan(axis, climb=0.0)
    true = replace(true, cam_from_world=look_at(np.array([0.0, 0, 400]), np.zeros(3), np.array([0.3, 1.0, 0])))
    flat = POINTS * [1, 1, 0]
    start = PlaneAffinity.of(flat, true.project(flat)).scan(axis, 256, 320, 2100.0)
    assert np.abs(start.project(flat) - true.project(flat)).max() < 1e-6
    assert start.skew == pytest.approx(true.skew)
    assert at_markers(start).intrinsics.aspect == pytest.approx(0.8)


# ---- phantoms -----------------------------------------------------------------------------------------

CUBES: tuple[dict[str, object], ...] = (
    {"cube_aspect": 0.7},
    {"cube_k1": 0.5},
    {"cube_scan": "rows", "scan_pitch_deg": 8.0, "scan_skew": 0.05},
    {"cube_scan": "columns", "cube_aspect": 1.4, "cube_rotation_deg": 30.0},
    {"cube_scan": "rows", "scan_wobble_mm": 0.3},
)


def settings(change: dict[str, object]) -> PhantomSettings:
    return replace(SMALL, cube_rows=64, cube_cols=80, bands=2, mesh_divisions=32, **change)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.parametrize("change", CUBES)
def test_truth_is_what_the_camera_sees_and_survives_its_file(tmp_path: Path, change: dict[str, object]) -> None:
    truth = Phantom(settings(change)).truth
    rows, cols = np.indices(truth.hsi_class.shape).reshape(2, -1)
    at = truth.hsi_view.project(truth.hsi_xyz.reshape(-1, 3).astype(float))
    assert np.abs(at - np.stack([cols, rows], 1)).max() < 1e-3
    assert {1, 2, 3} <= set(np.unique(truth.hsi_class))
    save_truth(truth, tmp_path / "truth.npz")
    again = load_truth(tmp_path).hsi_view
    assert type(again) is type(truth.hsi_view)
    assert again.project(POINTS) == pytest.approx(truth.hsi_view.project(POINTS))


def test_a_level_scan_keeps_its_height_and_frames_the_cards() -> None:
    for change in CUBES[2:]:
        view = hsi_view(settings(change))
        assert isinstance(view, ScanView)
        ends = view.origins(np.array([[0.0, 0.0], [79.0, 63.0]]))
        assert ends[0, 2] == pytest.approx(ends[1, 2])
        assert np.linalg.norm(ends[1] - ends[0]) > 30
    assert isinstance(hsi_view(settings(CUBES[4])), WobblyScan)


def test_a_camera_that_is_none_is_refused() -> None:
    wrong: list[dict[str, object]] = [{"cube_scan": "spiral"}, {"cube_aspect": 0.0}, {"scan_pitch_deg": 80.0}]
    for change in wrong:
        with pytest.raises(SettingsError):
            settings(change)
