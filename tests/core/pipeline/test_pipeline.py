"""The whole way from photos and cube to a cloud, against truth."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from specimap_core.cloud import Cloud, Flag
from specimap_core.errors import CancelledError
from specimap_core.photos.reading import AcquisitionSettings
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.truth.judge import TruthComparison, compare_with_truth
from specimap_core.truth.truth_file import Truth
from specimap_validation.phantom import load_truth
from tests.support.scenes import Finished, OnDisk, assert_same_result, read_corners, shared_run
from tests.support.shared_folders import SharedFolders


def judged(out: Path, truth: Truth) -> TruthComparison:
    """A run against truth, specimen pixels only."""
    ids, corners = read_corners(out)
    rows = [truth.marker_ids.tolist().index(i) for i in ids]
    cloud = Cloud.open(out / "cloud.zarr")
    return compare_with_truth(
        cloud.hsi_pixel,
        cloud.xyz,
        corners,
        truth.marker_corners[rows],
        truth.hsi_xyz.astype(float),
        truth.hsi_class == 1,
    )


def test_a_small_phantom_comes_out_true(finished: Finished, small: OnDisk) -> None:
    against = judged(finished.out, small.truth)
    assert 0.01 < against.median < 0.25
    assert against.coverage > 0.97
    assert 1e-7 < abs(against.scale) < 0.003
    report = finished.report
    assert len(report.photos.used) == 12
    assert 0.001 < report.corner_2d_mm.mean < 0.05
    assert 0.001 < report.corner_3d_mm.median < 0.2
    assert report.edge_length_mm.mean == pytest.approx(6.8, rel=0.003)
    assert report.inliers.of == 16
    assert report.inliers.threshold_mm == 6.0
    assert set(report.methods) == {"camera", "homography"}
    assert report.parallax_removed_mm.median > 0.1


def test_spectra_and_flags_are_those_of_their_pixels(finished: Finished, small: OnDisk) -> None:
    cloud = Cloud.open(finished.out / "cloud.zarr")
    values = small.values()
    chosen = np.random.default_rng(0).integers(0, cloud.n_points, 200)
    pixels = cloud.hsi_pixel[chosen]
    assert np.array_equal(cloud.stored_spectra(chosen), values[pixels[:, 0], pixels[:, 1]])
    true = small.truth.hsi_class[cloud.hsi_pixel[:, 0], cloud.hsi_pixel[:, 1]] == 1
    output = (cloud.flags & Flag.SPECIMEN) > 0
    assert (true & output).sum() / (true | output).sum() > 0.8
    card = small.truth.hsi_class[cloud.hsi_pixel[:, 0], cloud.hsi_pixel[:, 1]] == 2
    output = (cloud.flags & Flag.MARKER_CARD) > 0
    assert (card & output).sum() / (card | output).sum() > 0.8


@pytest.mark.slow
def test_a_run_repeats(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    heard: list[tuple[str, float]] = []
    run_pipeline(
        Inputs(small.photos, small.header),
        tmp_path / "out",
        PipelineSettings(),
        progress=lambda stage, share: heard.append((stage, share)),
        workers=1,
    )
    assert_same_result(tmp_path / "out", finished.out)
    stages = list(dict.fromkeys(stage for stage, _ in heard))
    assert stages == ["reconstruct", "adjust", "render", "register"]
    for stage in stages:
        shares = [share for s, share in heard if s == stage]
        assert shares == sorted(shares)
        assert shares[-1] == 1.0


def _note(heard: list[str], stage: str, _: float) -> None:
    heard.append(stage)


def test_a_stop_is_heard_in_every_stage(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    for k, stage in enumerate(("reconstruct", "adjust", "render", "register")):
        now: list[str] = []
        out = finished.copy_to(tmp_path / stage)
        for artefact in (out / "stages").iterdir():
            if k == 0 or (k == 1 and artefact.name.startswith("adjust")):
                artefact.unlink()
        (out / "report.json").unlink()
        with pytest.raises(CancelledError) as stopped:
            run_pipeline(
                Inputs(small.photos, small.header),
                out,
                PipelineSettings(),
                progress=partial(_note, now),
                cancelled=partial(now.__contains__, stage),
            )
        assert stopped.value.details["stage"] == stage
        assert not (out / "report.json").exists()
        assert not list(out.glob(".*.tmp"))


@pytest.mark.slow
def test_a_damaged_artefact_is_made_anew(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    (out / "report.json").unlink()
    (artefact,) = (out / "stages").glob("adjust-*")
    artefact.write_bytes(artefact.read_bytes()[:5000])
    report = run_pipeline(Inputs(small.photos, small.header), out, PipelineSettings())
    # The grids are taken over where the mesh comes out the same to the last bit.
    assert report.reused_stages in (["reconstruct"], ["reconstruct", "render"])
    assert_same_result(out, finished.out)


@pytest.mark.slow
def test_the_published_forms_run_too(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    settings = PipelineSettings()
    settings = replace(
        settings,
        adjust=replace(settings.adjust, form="free"),
        register=replace(settings.register, method="homography"),
    )
    out = finished.copy_to(tmp_path / "out")
    report = run_pipeline(Inputs(small.photos, small.header), out, settings)
    assert report.reused_stages == ["reconstruct"]
    assert (report.method, report.adjustment) == ("homography", "free")
    against = judged(out, small.truth)
    # Parallax: worse than the camera on the same photos, yet not out of the world.
    assert judged(finished.out, small.truth).median < against.median < 1.5


# ---- the full-size phantom ----------------------------------------------------------------------------


@pytest.mark.slow
def test_phantom_a_meets_its_targets(data_dir: Path, shared_folders: SharedFolders) -> None:
    folder = data_dir / "phantom_a"
    run = shared_run(shared_folders, folder)
    against = judged(run.out, load_truth(folder))
    assert 0.02 < against.median <= 0.12
    assert 0.05 < against.p95 <= 0.5
    assert against.coverage >= 0.97
    assert 1e-7 < abs(against.scale) <= 0.003
    assert 0.001 < run.report.corner_2d_mm.mean <= 0.03
    assert 0.001 < run.report.corner_3d_mm.median <= 0.15
    assert len(run.report.photos.used) == 24


@pytest.mark.slow
def test_half_of_phantom_a_is_enough(data_dir: Path, tmp_path: Path) -> None:
    folder = data_dir / "phantom_a"
    photos = tmp_path / "photos"
    photos.mkdir()
    for path in sorted((folder / "rgb").iterdir())[::2]:
        shutil.copy(path, photos)
    settings = replace(PipelineSettings(), acquisition=AcquisitionSettings(least_photos=6))
    report = run_pipeline(Inputs(photos, folder / "hsi" / "hsi.hdr"), tmp_path / "out", settings)
    against = judged(tmp_path / "out", load_truth(folder))
    assert len(report.photos.used) == 12
    assert 0.02 < against.median <= 0.2
    assert against.coverage >= 0.95
