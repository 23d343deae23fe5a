"""The cube's camera settled: by markers where they hold it, by the specimen elsewhere, and what is said of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from specimap_core.arrays import Singles
from specimap_core.cube import open_cube
from specimap_core.geometry.cameras import fit_similarity
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.register.camera_fitting import SHARED_MM, CubeObservations
from specimap_core.register.camera_refinement import LOOSE_MM, RefinedCamera, refine_camera
from specimap_core.register.corners import CornersInCube, corners_in_cube
from specimap_core.register.cube_camera import CubeCamera, solve_camera
from specimap_core.register.cube_markers import CubeMarkers, find_markers
from specimap_core.register.joint_layout import join_cube
from specimap_core.register.model_selection import fit_by_corners
from specimap_core.report.model import Report
from specimap_core.surface.raycast import RayCaster
from specimap_core.truth.judge import judge, judge_with_sigma
from specimap_validation.phantom import PhantomSettings, load_truth
from specimap_validation.phantom.render import CLASS_SPECIMEN
from tests.support.moved_specimen import (
    CORNERS,
    LARGER,
    VIEW,
    moved_by,
    seen,
    stage2_of,
    textured,
    turned,
)
from tests.support.reruns import Reruns, codes
from tests.support.scenes import bump_mesh, phantom_on_disk

ROWS, COLS = VIEW.intrinsics.height, VIEW.intrinsics.width
SHARP_PX, BLURRED_PX = 0.02, 0.5
ALL, THREE = (0, 1, 2, 3), (0, 1, 2)
SEEDS = range(8)
RAISED_MM = 1.5
MOVED_MM = (0.8, -0.5, 0.0)


@dataclass(frozen=True)
class Case:
    """A camera by the markers ``alone``, and ``refined``; how far the textured bump is off in either, mm."""

    alone: CubeCamera
    refined: RefinedCamera
    before_mm: float
    after_mm: float


@pytest.fixture(scope="module")
def caster() -> RayCaster:
    return RayCaster(textured())


@pytest.fixture(scope="module")
def picture(caster: RayCaster) -> Singles:
    return seen(caster.mesh)


def off_mm(camera: CubeCamera) -> float:
    """How far the raised part of the bump shows from where it should, sideways, root mean square."""
    vertices = bump_mesh().vertices.astype(float)
    raised = vertices[vertices[:, 2] > RAISED_MM]
    miss = camera.view.project(raised) - VIEW.project(raised)
    return float(np.sqrt((miss**2).sum(1).mean())) * camera.pixel_mm


def case(image: Singles, caster: RayCaster, ids: tuple[int, ...], noise_px: float, seed: int) -> Case:
    """The markers ``ids`` with noise on their corners, and the cube's image of the bump."""
    noise = np.random.default_rng(seed).normal(0, noise_px, (len(CORNERS), 4, 2))
    pixels = (VIEW.project(CORNERS.reshape(-1, 3)).reshape(-1, 4, 2) + noise)[list(ids)]
    sigma = np.full(len(ids), noise_px)
    corners = CornersInCube(ids, CORNERS[list(ids)], pixels, sigma)
    found = CubeMarkers(ids, pixels, sigma, image, "band mean", False)
    alone = solve_camera(*corners.flat(), ROWS, COLS)
    by_corners = fit_by_corners(CubeObservations(*corners.flat()), ROWS, COLS, alone)
    refined = refine_camera(corners, by_corners, found, caster, CORNERS)
    return Case(alone, refined, off_mm(alone), off_mm(refined.camera))


# ---- markers, and a textured bump ---------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_four_sharp_markers_hold_the_camera_and_the_specimen_agrees(
    caster: RayCaster, picture: Singles, seed: int
) -> None:
    found = case(picture, caster, ALL, SHARP_PX, seed)
    refined = found.refined
    assert refined.specimen_used
    assert refined.warnings() == []
    assert refined.shift is None
    assert 0 < refined.lateral_sd_mm < refined.marker_sd_mm < LOOSE_MM
    assert 0.001 < found.after_mm < 2 * refined.lateral_sd_mm


@pytest.mark.slow
@pytest.mark.parametrize("ids", [ALL, THREE])
def test_what_markers_leave_open_the_specimen_settles(
    caster: RayCaster, picture: Singles, ids: tuple[int, ...]
) -> None:
    cases = [found for seed in SEEDS if (found := case(picture, caster, ids, BLURRED_PX, seed)).refined.specimen_used]
    # Corners that are off by chance hide at times how far: not every draw is recognised as loose.
    assert len(cases) >= 6
    for found in cases:
        refined = found.refined
        assert found.after_mm < 3 * refined.lateral_sd_mm
        assert SHARED_MM / 2 < refined.lateral_sd_mm < refined.marker_sd_mm
        assert refined.warnings() == []
    before, after = (float(np.median(m)) for m in zip(*((c.before_mm, c.after_mm) for c in cases), strict=True))
    assert before > LOOSE_MM
    assert 0.002 < after < 2 * SHARED_MM


def test_what_nothing_settles_is_said(caster: RayCaster, picture: Singles) -> None:
    blank = np.full_like(picture, 0.5)
    flat = RayCaster(bump_mesh(height_mm=0.1))
    for image, surface, seed in [(blank, caster, 0), (blank, caster, 1), (seen(flat.mesh), flat, 0)]:
        found = case(image, surface, ALL, 2 * BLURRED_PX, seed)
        assert [w.code for w in found.refined.warnings()] == ["cube_camera_loose"]
        assert not found.refined.specimen_used
        assert found.refined.shift is None
        assert found.refined.lateral_sd_mm >= found.refined.marker_sd_mm > LOOSE_MM
        assert f"{found.refined.lateral_sd_mm:.1f} mm" in found.refined.warnings()[0].message


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_moved_specimen_does_not_draw_the_camera_along(caster: RayCaster, seed: int) -> None:
    image = seen(moved_by(caster.mesh, turned(0.0, np.array(MOVED_MM))))
    vertices = caster.mesh.vertices[caster.mesh.vertices[:, 2] > RAISED_MM].astype(float)
    for noise_px in (SHARP_PX, BLURRED_PX):
        refined = case(image, caster, ALL, noise_px, seed).refined
        # A motion is no fault of the camera's.
        loose = ["cube_camera_loose"] if refined.camera_sd_mm > LOOSE_MM else []
        assert [w.code for w in refined.warnings()] == ["specimen_moved", *loose]
        assert noise_px > SHARP_PX or not loose
        # Camera and motion together put each place of the specimen where the cube shows it.
        assert refined.followed is not None
        shown = VIEW.project(vertices + np.array(MOVED_MM))
        miss = refined.camera.view.project(refined.followed.motion.apply(vertices)) - shown
        off_mm = float(np.sqrt((miss**2).sum(1).mean())) * refined.camera.pixel_mm
        assert 0.001 < off_mm < min(2 * refined.lateral_sd_mm, 0.1)
        assert refined.followed.moved_mm == pytest.approx(np.hypot(*MOVED_MM[:2]), abs=0.05 + 0.2 * noise_px)


# ---- whole runs ---------------------------------------------------------------------------------------


def resolved(folder: Path) -> tuple[float, float, RefinedCamera]:
    """How far the specimen's true places show from their pixels, sideways, mm: by the run's markers alone, and settled
    as in its stage 4."""
    truth, stage2, cube = load_truth(folder), stage2_of(folder / "out"), open_cube(folder / "hsi" / "hsi.hdr")
    adjusted = stage2.adjusted
    found = find_markers(cube, "DICT_4X4_50", adjusted.marker_ids)
    corners = corners_in_cube(found, adjusted, cube.cols)
    alone = solve_camera(*corners.flat(), cube.rows, cube.cols)
    joint = join_cube(corners, adjusted, cube.rows, cube.cols)
    vertices = (stage2.mesh.vertices * joint.scale).astype(np.float32)
    caster, adjusted = RayCaster(replace(stage2.mesh, vertices=vertices)), joint.adjusted
    refined = refine_camera(corners, joint.by_corners, found, caster, adjusted.corners)
    true_corners = truth.marker_corners[[list(truth.marker_ids).index(i) for i in adjusted.marker_ids]]
    _, R, t = fit_similarity(true_corners.reshape(-1, 3), adjusted.corners.reshape(-1, 3))
    pixels = np.argwhere(truth.hsi_class == CLASS_SPECIMEN)
    places = truth.hsi_xyz[pixels[:, 0], pixels[:, 1]].astype(float) @ R.T + t

    def off(camera: CubeCamera) -> float:
        miss = camera.view.project(places) - pixels[:, ::-1]
        return float(np.sqrt((miss**2).sum(1).mean())) * camera.pixel_mm

    return off(alone), off(refined.camera), refined


@pytest.mark.slow
def test_a_run_with_two_markers_in_the_cube_is_settled(reruns: Reruns) -> None:
    folder, report = reruns.on(LARGER, (1, 3))
    assert report.marker_ids_in_cube == [0, 2]
    assert "markers_missing_in_cube" in codes(report)
    assert not codes(report) & {"specimen_moved", "cube_camera_loose"}
    before, after, refined = resolved(folder)
    assert refined.specimen_used
    assert refined.marker_sd_mm > LOOSE_MM
    assert 0.003 < after < min(before, 3 * refined.lateral_sd_mm)
    assert report.cube_camera.focal_px == pytest.approx(refined.camera.view.intrinsics.focal_px, rel=1e-3)
    # Half the markers, and the places are about as good as with all of them.
    error, usual = judge_with_sigma(folder / "out", folder).errors, judge(reruns.finished.out, reruns.small.folder)
    assert 0.02 < error.median < 1.3 * usual.median


@pytest.mark.slow
def test_a_run_states_that_the_specimen_moved_and_follows_it(reruns: Reruns) -> None:
    usual = judge(reruns.finished.out, reruns.small.folder)
    folder, report = reruns.on(replace(LARGER, moved_mm=MOVED_MM, moved_deg=2.0, moved_tilt_deg=1.0))
    message = next(w.message for w in report.warnings if w.code == "specimen_moved")
    assert "was followed as that of a rigid body" in message
    judged = judge_with_sigma(folder / "out", folder)
    # Each spectrum lies on its own tissue, about as well as where nothing moved.
    assert 0.5 * usual.median < judged.errors.median < 0.15
    assert judged.errors.coverage > 0.97
    assert judged.within(1) > 0.5
    assert judged.within(2) > 0.88


@pytest.mark.slow
def test_a_motion_too_small_for_a_warning_is_followed_too(reruns: Reruns) -> None:
    usual, moved_mm = judge(reruns.finished.out, reruns.small.folder), (0.2, -0.15, 0.0)
    folder, report = reruns.on(replace(LARGER, moved_mm=moved_mm))
    assert "specimen_moved" not in codes(report)
    judged = judge_with_sigma(folder / "out", folder)
    assert 0.5 * usual.median < judged.errors.median < 0.6 * float(np.hypot(*moved_mm[:2]))
    assert judged.within(1) > 0.5


@pytest.fixture(scope="module")
def blurred(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Report]:
    """A run on photos so blurred that one marker is read in none of them."""
    folder = tmp_path_factory.mktemp("blurred")
    settings = PhantomSettings(
        seed=21, blur_px=1.5, photos=14, cube_rows=256, cube_cols=320, bands=4, mesh_divisions=96
    )
    phantom = phantom_on_disk(folder, settings)
    return folder, run_pipeline(Inputs(phantom.photos, phantom.header), folder / "out", PipelineSettings())


@pytest.mark.slow
def test_a_run_on_blurred_photos_is_settled(blurred: tuple[Path, Report]) -> None:
    folder, report = blurred
    assert len(report.marker_ids_in_cube) == 3
    assert not codes(report) & {"specimen_moved", "cube_camera_loose"}
    before, after, refined = resolved(folder)
    assert refined.specimen_used
    # The specimen has more to say than the corners.
    assert refined.marker_sd_mm > refined.lateral_sd_mm
    assert 0.003 < after < min(before, 3 * refined.lateral_sd_mm)
    assert 0.3 * after < refined.lateral_sd_mm < LOOSE_MM
