"""The certificate sees the errors that truth shows, without knowing it, and calls planted faults."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from specimap_core.cube import open_cube
from specimap_core.geometry.cameras import Pose, rotation_from_vector
from specimap_core.pipeline.artefacts import load_stage1
from specimap_core.pipeline.outputs import Outputs
from specimap_core.report.model import Report
from specimap_core.surface.photo_consistency import Photographs, frontal_views
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.refinement import pixel_footprint_mm
from specimap_core.surface.regions import raised_mm
from specimap_core.truth.judge import judge_with_sigma
from specimap_core.verification.certificate import MOST_BAND_PX, MOST_LEAN_PX, MOST_PHOTO_SHIFT_PX
from specimap_core.verification.cube_picture import check_bands
from specimap_core.verification.figures import Certificate, SurfaceCheck
from specimap_core.verification.held_out import measure
from specimap_core.verification.sites import Sites
from specimap_core.verification.surface_check import check_surface
from specimap_validation.phantom import PhantomSettings
from tests.support.moved_specimen import stage2_of
from tests.support.scenes import Finished, cube_with, shared_phantom, shared_run
from tests.support.shared_folders import SharedFolders

MEDIUM: dict[str, Any] = {
    "photos": 18,
    "photo_size": 448,
    "cube_rows": 256,
    "cube_cols": 320,
    "bands": 16,
    "mesh_divisions": 96,
}
SHARP = PhantomSettings(seed=61, **MEDIUM)
BLURRED = PhantomSettings(
    seed=62, blur_px=0.7, gloss=0.3, exposure_spread=0.2, card_tilt_deg=1.0, card_lift_mm=0.3, **MEDIUM
)


def certificate_of(report: Report) -> Certificate:
    assert report.certificate is not None
    return report.certificate


@pytest.mark.slow
@pytest.mark.parametrize("settings", [SHARP, BLURRED], ids=["sharp", "blurred"])
def test_the_error_seen_is_the_true_one_within_a_half(shared_folders: SharedFolders, settings: PhantomSettings) -> None:
    phantom = shared_phantom(shared_folders, settings)
    run = shared_run(shared_folders, phantom.folder)
    found, true = certificate_of(run.report), judge_with_sigma(run.out, phantom.folder).errors
    assert found.verdict == "trusted", found
    assert found.reasons == []
    assert found.total_mm is not None
    assert true.median / 1.5 < found.total_mm.median < 1.5 * true.median
    assert true.p95 / 3 < found.total_mm.p95 < 3 * true.p95
    assert found.sigma_factor < 1.3
    assert found.surface.places > 200


@pytest.fixture(scope="module")
def sharp(shared_folders: SharedFolders) -> Finished:
    return shared_run(shared_folders, shared_phantom(shared_folders, SHARP).folder)


@cache
def _stages(out: Path) -> tuple[Any, Any]:
    (artefact,) = (out / "stages").glob("reconstruct-*.npz")
    stage1 = load_stage1(Outputs(out).store, artefact.stem.partition("-")[2], with_depth=False)
    assert stage1 is not None
    return stage1, stage2_of(out)


def checked(
    out: Path, *, focal: float = 1.0, lifted_mm: float = 0.0, turned: tuple[int, ...] = (), by: float = 0.0015
) -> SurfaceCheck:
    """The check of a run's surface with its lens, its height or some of its poses changed afterwards."""
    stage1, stage2 = _stages(out)
    adjusted, mesh = stage2.adjusted, stage2.mesh
    lens = replace(adjusted.lens, focal_px=adjusted.lens.focal_px * focal)
    aside = Pose(rotation_from_vector(np.array([0.0, by, 0.0])), np.zeros(3))
    poses = tuple(aside @ p if k in turned else p for k, p in enumerate(adjusted.poses))
    raised = np.flatnonzero((mesh.vertices[:, 2] > raised_mm(adjusted.corners)) & (mesh.normals[:, 2] > 0.5))
    chosen = raised[:: max(1, len(raised) // 150)]
    mesh = replace(mesh, vertices=(mesh.vertices + np.float32(lifted_mm) * mesh.normals).astype(np.float32))
    caster = RayCaster(mesh)
    photographs = Photographs([g.astype(np.float32) for g in stage1.greys], lens, poses)
    points, normals = mesh.vertices[chosen].astype(float), mesh.normals[chosen].astype(float)
    views = frontal_views(caster, chosen, photographs, len(poses), 0.25)
    seen = (views[:, :, None] == np.arange(len(poses))).any(1)
    # Every second photo predicts the others.
    sites = Sites(points, normals, seen & (np.arange(len(poses)) % 2 == 0), seen, np.ones(len(points)))
    pixel_mm = pixel_footprint_mm(lens, poses, points.mean(0))
    return check_surface(sites, measure(sites, photographs, caster), pixel_mm, stage1.names)


@pytest.mark.slow
def test_a_surface_that_lies_off_is_measured(sharp: Finished) -> None:
    plain = checked(sharp.out)
    assert plain.lean_mm is not None
    for lifted in (-0.08, 0.08):
        found = checked(sharp.out, lifted_mm=lifted)
        assert found.lean_mm is not None
        assert found.offset_mm is not None
        # Too high by so much: truth lies lower.
        assert found.lean_mm - plain.lean_mm == pytest.approx(-lifted, abs=0.02)
        assert found.offset_mm == pytest.approx(0.08, abs=0.03)


@pytest.mark.slow
def test_a_wrong_lens_and_wrong_poses_are_called(sharp: Finished) -> None:
    plain = checked(sharp.out)
    assert plain.lean_mm is not None
    assert plain.photo_shift_px is not None
    assert abs(plain.lean_mm) < MOST_LEAN_PX * plain.pixel_mm / 2
    assert 0.001 < plain.photo_shift_px < MOST_PHOTO_SHIFT_PX / 3
    lens = checked(sharp.out, focal=1.01)
    assert lens.lean_mm is not None
    assert abs(lens.lean_mm) > MOST_LEAN_PX * lens.pixel_mm
    turned = checked(sharp.out, turned=(1, 3, 5))
    assert turned.photo_shift_px is not None
    assert turned.photo_shift_px > MOST_PHOTO_SHIFT_PX


@pytest.mark.slow
@pytest.mark.parametrize("by", [0.0015, 0.004, 0.03])
def test_a_single_photo_with_a_wrong_pose_is_named(sharp: Finished, by: float) -> None:
    """Off by one pixel, by some, and by so many that nothing is recognised any more."""
    assert checked(sharp.out).photos_off == ()
    stage1, _ = _stages(sharp.out)
    for photo in (5, 9):
        found = checked(sharp.out, turned=(photo,), by=by)
        assert found.photos_off == (stage1.names[photo],)
        # The others do not speak against all.
        assert found.photo_shift_px is not None
        assert found.photo_shift_px < MOST_PHOTO_SHIFT_PX


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0.0, 0.4])
def test_bands_that_lie_apart_are_measured(shared_folders: SharedFolders, tmp_path: Path, shift: float) -> None:
    phantom = shared_phantom(shared_folders, SHARP)
    values = phantom.values()
    for band in range(values.shape[2] if shift else 0):
        move = np.array([[1, 0, shift * band / (values.shape[2] - 1)], [0, 1, 0]])
        size = values.shape[1::-1]
        values[..., band] = cv2.warpAffine(values[..., band], move, size, borderMode=cv2.BORDER_REPLICATE)
    cube = open_cube(cube_with(values, phantom, tmp_path))
    corners = phantom.truth.hsi_view.project(phantom.truth.marker_corners)
    found = check_bands(cube, corners)
    assert found is not None
    assert found.sigma_px > 0
    # Between the middles of the first and the last of three thirds lie 11 of 15 bands.
    assert found.shift_px == pytest.approx(shift * 11 / 15, abs=0.03)
    assert found.growth_px < MOST_BAND_PX
