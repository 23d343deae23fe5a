"""Markers that are absent, mirrored, of another dictionary or edge: a stable code and advice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import pytest
from PIL import ExifTags, Image

from specimap_core.cloud import Cloud
from specimap_core.pipeline.options import OPTIONS
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.model import Report
from specimap_core.truth.judge import compare_with_truth
from tests.support.broken_sets import copied, image_of, without_markers
from tests.support.scenes import SMALL, TINY, OnDisk, phantom_on_disk, read_corners, run_refused, specimap

# ---- markers --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_no_marker_anywhere(small: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    for path in photos.iterdir():
        without_markers(path, small)
    assert run_refused(photos, small.header, tmp_path / "out")["code"] == "no_markers_found"


@pytest.mark.slow
def test_mirrored_photos_are_said_to_be_mirrored(small: OnDisk, tmp_path: Path) -> None:
    """As a phone's front camera stores them."""
    photos = copied(small.photos, tmp_path / "photos")
    for path in photos.iterdir():
        cv2.imwrite(str(path), image_of(path)[:, ::-1])
    refusal = run_refused(photos, small.header, tmp_path / "out")
    assert refusal["code"] == "no_markers_found"
    assert "mirrored" in str(refusal["message"])


@pytest.mark.slow
@pytest.mark.parametrize("given", ["DICT_5X5_50", "DICT_6X6_1000", "DICT_APRILTAG_16h5", "DICT_7X7_1000"])
def test_markers_of_another_dictionary(small: OnDisk, tmp_path: Path, given: str) -> None:
    refusal = run_refused(small.photos, small.header, tmp_path / "out", "--dictionary", given)
    assert refusal["code"] == "marker_dictionary_wrong"
    assert "DICT_4X4_1000" in str(refusal["advice"])


@pytest.mark.slow
def test_a_layout_of_one_marker_is_refused_at_the_cube(tmp_path: Path) -> None:
    phantom = phantom_on_disk(tmp_path, replace(TINY, marker_ids=(5,)))
    refusal = run_refused(phantom.photos, phantom.header, tmp_path / "out")
    assert refusal["code"] == "markers_missing_in_cube"


@pytest.mark.slow
def test_other_layouts_work(tmp_path: Path) -> None:
    """Nine markers of another dictionary and edge."""
    settings = replace(
        SMALL, marker_ids=tuple(range(20, 29)), dictionary="DICT_6X6_250", edge_mm=10.0, bands=4, photo_size=512
    )
    phantom = phantom_on_disk(tmp_path, settings)
    pipeline = PipelineSettings()
    pipeline = replace(
        pipeline,
        reconstruct=replace(pipeline.reconstruct, dictionary="DICT_6X6_250", edge_mm=10.0),
        adjust=replace(pipeline.adjust, edge_mm=10.0),
    )
    report = run_pipeline(Inputs(phantom.photos, phantom.header), tmp_path / "out", pipeline)
    ids, corners = read_corners(tmp_path / "out")
    assert len(ids) >= 8
    cloud = Cloud.open(tmp_path / "out" / "cloud.zarr")
    true_corners = phantom.truth.marker_corners[[list(settings.marker_ids).index(i) for i in ids]]
    against = compare_with_truth(
        cloud.hsi_pixel,
        cloud.xyz,
        corners,
        true_corners,
        phantom.truth.hsi_xyz.astype(float),
        phantom.truth.hsi_class == 1,
    )
    assert 0.01 < against.median < 0.4
    assert abs(against.scale) < 0.005
    assert report.edge_length_mm.mean == pytest.approx(10, rel=0.01)


# ---- scale ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("edge", "named"),
    [(0.3, "0.3 inches are 7.62 mm"), (0.268, "0.268 inches"), (0.68, "0.68 centimetres are 6.8 mm")],
)
def test_an_edge_in_another_unit_is_refused(
    small: OnDisk, tmp_path: Path, edge: float, named: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The unit's own range is not what is asked for here.
    monkeypatch.setitem(OPTIONS, "edge_mm", replace(OPTIONS["edge_mm"], bounds=(0.01, 1000.0)))
    refusal = run_refused(small.photos, small.header, tmp_path / "out", "--edge-mm", edge)
    assert refusal["code"] == "edge_implausible"
    assert named in str(refusal["advice"])
    assert refusal["details"]["distance_mm"] == pytest.approx(150 * edge / 6.8, rel=0.1)  # type: ignore[index]


def test_an_edge_far_too_large_is_refused(small: OnDisk, tmp_path: Path) -> None:
    refusal = run_refused(small.photos, small.header, tmp_path / "out", "--edge-mm", 180)
    assert refusal["code"] == "edge_implausible"
    assert "4.0 m" in str(refusal["message"])


def with_subject(photos: Path, folder: Path, metres: float) -> Path:
    """Copies of photos whose EXIF states a distance."""
    folder.mkdir()
    for path in photos.iterdir():
        with Image.open(path) as image:
            exif = Image.Exif()
            exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.SubjectDistance] = metres
            image.save(folder / path.name, quality=95, exif=exif)
    return folder


def test_an_edge_that_exif_and_reason_contradict_is_refused(small: OnDisk, tmp_path: Path) -> None:
    photos = with_subject(small.photos, tmp_path / "photos", 0.15)
    refusal = run_refused(photos, small.header, tmp_path / "out", "--edge-mm", 68)
    assert refusal["code"] == "edge_implausible"
    assert "EXIF says 150 mm" in str(refusal["message"])


@pytest.mark.slow
def test_a_doubtful_edge_is_warned_of(tiny: OnDisk, tmp_path: Path) -> None:
    photos = with_subject(tiny.photos, tmp_path / "photos", 0.4)
    answer = specimap(
        "run", "--photos", photos, "--cube", tiny.header, "--out", tmp_path / "out", "--edge-mm", 68, "--json"
    )
    assert answer.status == 0
    report = Report.model_validate(answer.events[-1]["report"])
    assert {"scale_implausible", "scale_contradicts_exif"} <= {w.code for w in report.warnings}
