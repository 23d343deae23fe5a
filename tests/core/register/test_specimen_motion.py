"""A specimen that moved between photos and cube is noticed, and one that did not is left in peace."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from specimap_core.cube import Cube, open_cube
from specimap_core.geometry.cameras import Intrinsics, View
from specimap_core.photos.folder import photo_paths
from specimap_core.pipeline.artefacts import Stage2
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.outputs import Outputs
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.pipeline.stages import adjust_stage, reconstruct_stage
from specimap_core.register.corners import CornersInCube
from specimap_core.register.cube_camera import solve_camera
from specimap_core.register.cube_markers import find_markers
from specimap_core.register.specimen_motion import ALLOWED_MM, Shift, measure_motion
from specimap_core.surface.raycast import RayCaster
from specimap_validation.phantom import Phantom, PhantomSettings, write_cube
from tests.support.moved_specimen import (
    CORNERS,
    LARGER,
    TOLERANCE_MM,
    VIEW,
    moved_by,
    seen,
    stage2_of,
    textured,
    turned,
)
from tests.support.scenes import Finished, OnDisk, bump_mesh, phantom_on_disk, shared_run
from tests.support.shared_folders import SharedFolders


def shift_in(stage2: Stage2, cube: Cube) -> Shift | None:
    """As stage 4 calls it."""
    found = find_markers(cube, "DICT_4X4_50", stage2.adjusted.marker_ids)
    rows = [stage2.adjusted.marker_ids.index(i) for i in found.marker_ids]
    seen = CornersInCube(found.marker_ids, stage2.adjusted.corners[rows], found.corners_px, found.sigma_px)
    camera = solve_camera(*seen.flat(), cube.rows, cube.cols)
    corners = stage2.adjusted.corners
    return measure_motion(
        found.image,
        camera.view,
        RayCaster(stage2.mesh),
        corners,
        markers_in_cube=len(found.marker_ids),
        mirrored=found.mirrored,
    )


def cube_of(settings: PhantomSettings, folder: Path) -> Cube:
    write_cube(Phantom(settings).cube(), settings.wavelengths_nm, folder / "hsi.hdr", interleave="bsq")
    return open_cube(folder / "hsi.hdr")


def surface_of(phantom: OnDisk, out: Path) -> Stage2:
    """What the first two stages make of a phantom's photos."""
    paths, settings, store = photo_paths(phantom.photos), PipelineSettings(), Outputs(out).store
    out.mkdir()
    clock = Clock(lambda stage, share: None, lambda: False)
    stage1 = reconstruct_stage(paths, settings, store, "1", clock, 2)
    return adjust_stage(stage1, settings, store, "2", clock, 2)


# ---- phantoms, by their own reconstruction ------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("moved_mm", [(0.8, -0.6, 0.0), (-2.4, 1.8, 0.0)])
def test_a_shift_is_noticed_and_measured(
    finished: Finished, tmp_path: Path, moved_mm: tuple[float, float, float]
) -> None:
    shift = shift_in(stage2_of(finished.out), cube_of(replace(LARGER, moved_mm=moved_mm), tmp_path))
    assert shift is not None
    assert shift.significant
    true = float(np.hypot(*moved_mm[:2]))
    assert shift.moved_mm == pytest.approx(true, abs=TOLERANCE_MM)
    assert np.hypot(*shift.shift_mm) == pytest.approx(true, abs=TOLERANCE_MM)
    assert abs(shift.turn_deg) < 0.5
    assert 0.01 < shift.sigma_mm < 0.1


def test_a_turn_is_noticed(finished: Finished, tmp_path: Path) -> None:
    shift = shift_in(stage2_of(finished.out), cube_of(replace(LARGER, moved_deg=4.0), tmp_path))
    assert shift is not None
    assert shift.significant
    # Tiles see the middle of their part of the turn, and are drawn to the tray at the outline, which stays.
    assert 3.0 < shift.turn_deg < 4.2
    assert np.hypot(*shift.shift_mm) < ALLOWED_MM


@pytest.mark.parametrize("rotation", [0.0, 90.0])
def test_a_still_specimen_is_left_in_peace(finished: Finished, tmp_path: Path, rotation: float) -> None:
    settings = replace(LARGER, cube_rotation_deg=rotation, cube_noise=0.02, dead_pixel_fraction=0.01)
    shift = shift_in(stage2_of(finished.out), cube_of(settings, tmp_path))
    assert shift is not None
    assert not shift.significant
    assert 1e-4 < shift.moved_mm < TOLERANCE_MM


@pytest.mark.slow
@pytest.mark.parametrize(
    "change",
    [
        {"seed": 2, "gloss": 0.6},
        {"seed": 3, "card_tilt_deg": 2.5, "card_lift_mm": 0.5, "texture_contrast": 0.2},
        {"seed": 4, "blur_px": 0.8, "exposure_spread": 0.4},
    ],
)
def test_defects_are_not_taken_for_motion(tmp_path: Path, change: dict[str, object]) -> None:
    settings = replace(LARGER, photos=10, **change)  # type: ignore[arg-type]
    phantom = phantom_on_disk(tmp_path / "phantom", settings)
    stage2 = surface_of(phantom, tmp_path / "out")
    still = shift_in(stage2, open_cube(phantom.header))
    assert still is None or not still.significant
    moved = shift_in(stage2, cube_of(replace(settings, moved_mm=(1.2, 1.6, 0.0)), tmp_path / "moved"))
    assert moved is not None
    assert moved.significant
    assert moved.moved_mm == pytest.approx(2.0, abs=2 * TOLERANCE_MM)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["phantom_a", "phantom_hard"])
def test_path_traced_specimens_did_not_move(data_dir: Path, shared_folders: SharedFolders, name: str) -> None:
    run = shared_run(shared_folders, data_dir / name)
    shift = shift_in(stage2_of(run.out), open_cube(data_dir / name / "hsi" / "hsi.hdr"))
    assert shift is not None
    assert not shift.significant
    assert 1e-4 < shift.moved_mm < TOLERANCE_MM


# ---- a textured bump, without a pipeline --------------------------------------------------------------


@pytest.mark.parametrize("width", [497, 500, 503])
def test_an_image_brought_to_working_size_keeps_its_place(width: int) -> None:
    # No whole number of working pixels fits these widths; half of one is 0.1 mm at the far side.
    fine = View(Intrinsics.centred(width, 401, 2470.0), VIEW.cam_from_world)
    mesh = textured()
    shift = measure_motion(seen(mesh, view=fine), fine, RayCaster(mesh), CORNERS, markers_in_cube=4)
    assert shift is not None
    assert 1e-5 < np.hypot(*shift.shift_mm) < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize(("x", "y", "degrees"), [(1.5, -0.7, 0.0), (-3.0, 4.0, 0.0), (0.4, 0.6, 3.0), (0.0, 0.0, 0.0)])
def test_direction_and_turn_are_those_of_the_marker_frame(x: float, y: float, degrees: float, mirrored: bool) -> None:
    mesh = textured()
    image = seen(moved_by(mesh, turned(degrees, np.array([x, y, 0.0]))))
    image = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
    shift = measure_motion(image, VIEW, RayCaster(mesh), CORNERS, markers_in_cube=4, mirrored=mirrored)
    assert shift is not None
    # Half a working pixel.
    assert shift.shift_mm == pytest.approx((x, y), abs=0.1)
    assert shift.turn_deg == pytest.approx(degrees, abs=0.25 * degrees + 0.3)
    assert shift.significant == bool(x or y or degrees)


@pytest.mark.slow
def test_nothing_is_said_where_nothing_can_be_told() -> None:
    rng = np.random.default_rng(1)
    caster, image = RayCaster(textured()), seen(textured())
    assert measure_motion(np.full(image.shape, 0.5, np.float32), VIEW, caster, CORNERS, markers_in_cube=4) is None
    assert measure_motion(np.full(image.shape, np.nan, np.float32), VIEW, caster, CORNERS, markers_in_cube=4) is None
    for _ in range(5):
        noise = rng.uniform(0, 1, image.shape).astype(np.float32)
        assert measure_motion(noise, VIEW, caster, CORNERS, markers_in_cube=4) is None
    flat = bump_mesh(height_mm=0.1)
    assert measure_motion(seen(flat), VIEW, RayCaster(flat), CORNERS, markers_in_cube=4) is None
    # Another specimen altogether.
    other = replace(textured(), colours=rng.integers(20, 230, (len(textured().vertices), 3)).astype(np.uint8))
    assert measure_motion(seen(other), VIEW, caster, CORNERS, markers_in_cube=4) is None
    # Three markers leave the camera too loose.
    moved = seen(moved_by(textured(), turned(0.0, np.array([2.0, 0, 0]))))
    assert measure_motion(moved, VIEW, caster, CORNERS, markers_in_cube=4) is not None
    assert measure_motion(moved, VIEW, caster, CORNERS, markers_in_cube=3) is None
