"""The published way: MASt3R's own cameras and depth, free corners, refined poses applied to its dense points."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from specimap_core.bundle_adjust.adjust import AdjustSettings
from specimap_core.geometry.cameras import Pose, fit_similarity, rotation_from_vector
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backend import ReconstructSettings
from specimap_core.reconstruct.backends.environment import backends_from
from specimap_core.reconstruct.backends.mast3r import backend
from specimap_core.reconstruct.backends.mast3r.settings import PREFIX, Mast3rSettings
from specimap_core.truth.judge import judge
from tests.support.backend_files import bring_mast3r
from tests.support.mast3r_scene import (
    CLOSE_MM,
    SCRIPT,
    Seen,
    adjusted_errors_mm,
    answer_of,
    reconstruct,
    scripted_settings,
    see,
    true_points,
)
from tests.support.notices import messages
from tests.support.scenes import SMALL, OnDisk

FRAME = Pose(rotation_from_vector(np.array([-0.6, 0.2, 1.3])), np.array([3.0, 40.0, -70.0]))
"""Between the phantom's world and that of the predictions."""
REACH_MM = 30.0
"""How far from the layout's middle the markers stand."""


@pytest.fixture(scope="module")
def seen(small: OnDisk) -> Seen:
    return see(small.photos, SMALL, 192)


@pytest.fixture
def settings(tmp_path: Path) -> Mast3rSettings:
    return scripted_settings(tmp_path, 192)


@pytest.mark.slow
def test_cameras_and_depth_are_the_networks_but_for_frame_and_scale(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    unit_mm, factor = 700.0, 1.01
    arrays = answer_of(seen, unit_mm=unit_mm, frame=FRAME, focal_factor=factor)
    found = reconstruct(seen, arrays, settings, monkeypatch, hold_to_markers=False)
    assert found.photos == tuple(range(12))
    assert len(found.maps) == 12
    truth = [v.cam_from_world for v in small.truth.views]
    lens = small.truth.views[0].intrinsics
    assert found.lens.focal_px == pytest.approx(factor * lens.focal_px, rel=1e-9)
    assert (found.lens.k1, found.lens.k2) == (0.0, 0.0)
    # One similarity takes all cameras and all depth to truth.
    scale, R, t = fit_similarity(
        np.stack([p.centre for p in found.poses]), np.stack([p.centre for p in truth]), with_scale=True
    )
    assert abs(scale - 1) > 1e-5  # the wrong focal length leaves a wrong scale
    assert abs(scale - 1) < 2 * (factor - 1)
    for pose, true in zip(found.poses, truth, strict=True):
        assert np.allclose(scale * R @ pose.centre + t, true.centre, atol=1e-4)
        assert np.allclose(pose.R, true.R @ R, atol=1e-7)
    for m, true_xyz in zip(found.maps, true_points(found, seen), strict=True):
        depth = truth[m.photo].apply(true_xyz)[:, 2]
        assert np.allclose(scale * m.depth[m.depth > 0], depth, rtol=1e-5)


def test_refined_poses_put_exact_depth_where_it_is(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = reconstruct(seen, answer_of(seen, frame=FRAME), settings, monkeypatch, hold_to_markers=False)
    # The corners' noise alone is left.
    assert 1e-3 < float(np.median(adjusted_errors_mm(found, seen, small.truth, "free"))) < CLOSE_MM


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_a_wrong_focal_length_stays_in_the_published_cloud(
    seen: Seen, small: OnDisk, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch, factor: float
) -> None:
    arrays = answer_of(seen, frame=FRAME, focal_factor=factor)
    median = {}
    for hold, form in [(True, "rigid"), (False, "free"), (False, "rigid")]:
        found = reconstruct(seen, arrays, settings, monkeypatch, hold_to_markers=hold)
        median[hold, form] = float(np.median(adjusted_errors_mm(found, seen, small.truth, form)))  # type: ignore[arg-type]
    off_mm = abs(factor - 1) * REACH_MM
    assert 1e-3 < median[True, "rigid"] < CLOSE_MM
    # Seen under angles off by a fiftieth, places are off by up to a fiftieth of how far out they are.
    assert 2 * median[True, "rigid"] < median[False, "free"] < off_mm
    # Why the two go together: poses refined with another focal length than depth was found with move it far more.
    distance_mm = float(np.median([np.linalg.norm(v.cam_from_world.centre) for v in small.truth.views]))
    assert off_mm < median[False, "rigid"] < 1.5 * abs(factor - 1) * distance_mm


def test_a_photo_that_is_placed_wrongly_is_placed_by_its_markers(
    seen: Seen, settings: Mast3rSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    arrays = answer_of(seen)
    arrays["cam_to_world"][5] = arrays["cam_to_world"][8]
    found = reconstruct(seen, arrays, settings, monkeypatch, hold_to_markers=False)
    assert found.photos == tuple(range(12))
    assert {m.photo for m in found.maps} == set(range(12)) - {5}
    assert seen.photos[5].name in messages(found.warnings)["depth_unaligned"]


@pytest.mark.slow
def test_a_run_with_free_corners_goes_the_published_way(
    seen: Seen, small: OnDisk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    factor = 1.01
    bring_mast3r(tmp_path, monkeypatch)
    np.savez(tmp_path / "answer.npz", **answer_of(seen, frame=FRAME, focal_factor=factor))  # type: ignore[arg-type]
    monkeypatch.setenv("ANSWER", str(tmp_path / "answer.npz"))
    monkeypatch.setenv(PREFIX + "SIZE_PX", "192")
    monkeypatch.setattr(backend, "CHILD", SCRIPT)
    # The script needs none of what a real network would import.
    monkeypatch.setattr("specimap_core.reconstruct.backends.requirements.check_backend", lambda name, backends: None)
    settings = PipelineSettings(reconstruct=ReconstructSettings(backend="mast3r"), adjust=AdjustSettings("free"))
    backends = backends_from(os.environ, "mast3r")
    report = run_pipeline(Inputs(small.photos, small.header), tmp_path / "out", settings, backends=backends, workers=2)
    assert (report.backend, report.adjustment) == ("mast3r", "free")
    assert settings.for_stage1().hold_to_markers is False
    assert report.settings["reconstruct"] == asdict(settings.for_stage1())
    true = small.truth.views[0].intrinsics
    assert report.photo_focal_px == pytest.approx(factor * true.focal_px, rel=1e-9)
    assert report.edge_length_mm.mean == pytest.approx(6.8, rel=5e-3)
    found = judge(tmp_path / "out", small.folder)
    # A network's pixel is 0.4 mm, and a hundredth of how far out the markers stand comes to it.
    assert 0.02 < found.median < 0.3 + abs(factor - 1) * REACH_MM
    assert found.coverage > 0.9
