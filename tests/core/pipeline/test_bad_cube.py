"""Bad cubes: a stable code, advice, nothing lost. Stages 1 and 2 are taken over from the finished run."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.cube import open_cube
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.report.model import Report
from tests.support.scenes import Finished, OnDisk, cube_with, run_refused, tree_of, xyz_image

Values = NDArray[np.uint16]


def rerun(small: OnDisk, out: Path, cube: Path) -> Report:
    report = run_pipeline(Inputs(small.photos, cube), out, PipelineSettings())
    assert report.reused_stages == ["reconstruct", "adjust", "render"]
    return report


def header_edited(small: OnDisk, folder: Path, old: str, new: str, *, data: bool = True) -> Path:
    folder.mkdir()
    text = small.header.read_text()
    assert old in text
    (folder / "hsi.hdr").write_text(text.replace(old, new))
    if data:
        shutil.copy(small.header.with_suffix(".raw"), folder / "hsi.raw")
    return folder / "hsi.hdr"


def test_cubes_that_do_not_open(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    before = tree_of(out)
    folder = tmp_path / "cubes"
    folder.mkdir()
    assert run_refused(small.photos, folder / "none.hdr", out)["code"] == "cube_not_found"
    bare = header_edited(small, folder / "bare", "ENVI", "ENVI", data=False)
    assert run_refused(small.photos, bare, out)["code"] == "cube_not_found"
    typo = header_edited(small, folder / "typo", "interleave = bsq", "interleave = bup")
    refusal = run_refused(small.photos, typo, out)
    assert refusal["code"] == "cube_header_invalid"
    assert refusal["details"]["field"] == "interleave"  # type: ignore[index]
    longer = header_edited(small, folder / "longer", "lines = 128", "lines = 256")
    refusal = run_refused(small.photos, longer, out)
    assert refusal["code"] == "cube_truncated"
    size = small.header.with_suffix(".raw").stat().st_size
    details = refusal["details"]
    assert isinstance(details, dict)
    assert {size, 2 * size} <= set(details.values())
    text = folder / "text.hdr"
    text.write_text("a letter")
    assert str(run_refused(small.photos, text, out)["code"]).startswith("cube_")
    assert tree_of(out) == before


def test_cubes_without_content(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    before = tree_of(out)
    np.save(tmp_path / "nan.npy", np.full((40, 50, 3), np.nan, np.float32))
    assert run_refused(small.photos, tmp_path / "nan.npy", out)["code"] == "cube_content_invalid"
    np.save(tmp_path / "zero.npy", np.zeros((40, 50, 3), np.uint16))
    assert run_refused(small.photos, tmp_path / "zero.npy", out)["code"] == "cube_content_invalid"
    rng = np.random.default_rng(0)
    np.save(tmp_path / "noise.npy", rng.integers(0, 9000, (60, 70, 3), dtype=np.uint16))
    refusal = run_refused(small.photos, tmp_path / "noise.npy", out)
    assert refusal["code"] == "markers_missing_in_cube"
    assert refusal["details"] == {"seen": [], "wanted": [0, 1, 2, 3]}
    assert tree_of(out) == before


def saturated(values: Values) -> Values:
    values[60:70, 70:90] = 65535
    return values


def dark_bands(values: Values) -> Values:
    values[..., 3:6] = 0
    return values


def one_band(values: Values) -> Values:
    return values[..., 2:3]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "code"), [(saturated, "saturated"), (dark_bands, "bands_all_zero"), (one_band, "single_band")]
)
def test_cubes_with_flaws_are_used_with_a_warning(
    small: OnDisk, finished: Finished, tmp_path: Path, change: Callable[[Values], Values], code: str
) -> None:
    cube = cube_with(change(small.values()), small, tmp_path / "cube")
    report = rerun(small, finished.copy_to(tmp_path / "out"), cube)
    assert code in {w.code for w in report.warnings}
    assert report.coverage.points > 5000


@pytest.mark.slow
def test_pixels_that_are_not_numbers(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    values = small.values().astype(np.float32) / 10000
    values[50:60, 40:80] = np.nan
    np.savez(tmp_path / "cube.npz", cube=values, wavelengths=small.truth.wavelengths_nm)
    report = rerun(small, finished.copy_to(tmp_path / "out"), tmp_path / "cube.npz")
    assert "pixels_nan" in {w.code for w in report.warnings}
    assert report.corner_2d_mm.mean < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("how", ["90", "180", "270", "fliplr", "flipud"])
def test_a_turned_or_mirrored_cube_gives_the_same_places(
    small: OnDisk, finished: Finished, tmp_path: Path, how: str
) -> None:
    values = small.values()
    turns = {"90": 1, "180": 2, "270": 3}.get(how, 0)

    def change(image: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.rot90(image, turns) if turns else getattr(np, how)(image)

    out = finished.copy_to(tmp_path / "out")
    report = rerun(small, out, cube_with(np.asarray(change(values), np.uint16), small, tmp_path / "cube"))
    straight = xyz_image(finished.out, values.shape[:2])
    expected = np.asarray(change(straight), np.float32)
    apart = np.linalg.norm(xyz_image(out, (expected.shape[0], expected.shape[1])) - expected, axis=-1)
    both = np.isfinite(apart)
    assert both.mean() > 0.95 * np.isfinite(straight[..., 0]).mean()
    assert np.median(apart[both]) < 0.03
    mirrored = not turns
    assert report.cube_camera.mirrored == mirrored
    assert ("cube_mirrored" in {w.code for w in report.warnings}) == mirrored
    if turns:
        by = (report.cube_camera.roll_deg - finished.report.cube_camera.roll_deg) % 360
        assert min(abs(by - 90 * turns), abs(by - 360 + 90 * turns)) < 1


def hidden(small: OnDisk, ids: tuple[int, ...]) -> Values:
    """Lay something grey over markers in the cube."""
    values = small.values()
    mask = np.zeros(values.shape[:2], np.uint8)
    for i in ids:
        corners = small.truth.marker_corners[i]
        larger = corners.mean(0) + 1.2 * (corners - corners.mean(0))
        cv2.fillConvexPoly(mask, np.round(small.truth.hsi_view.project(larger)).astype(np.int32), 1)
    values[mask > 0] = 3000
    return values


@pytest.mark.slow
def test_a_marker_hidden_in_the_cube(small: OnDisk, finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    report = rerun(small, out, cube_with(hidden(small, (2,)), small, tmp_path / "one"))
    assert report.inliers.of == 12
    assert report.marker_ids_in_cube == [0, 1, 3]
    (warning,) = [w for w in report.warnings if w.code == "markers_missing_in_cube"]
    assert "12" in warning.message
    before = tree_of(out)
    three = cube_with(hidden(small, (0, 1, 3)), small, tmp_path / "three")
    refusal = run_refused(small.photos, three, out)
    assert refusal["code"] == "markers_missing_in_cube"
    assert refusal["details"] == {"seen": [2], "wanted": [0, 1, 2, 3]}
    assert tree_of(out) == before


@pytest.mark.slow
def test_what_the_reader_assumed_is_said_where_no_marker_shows(
    small: OnDisk, finished: Finished, tmp_path: Path
) -> None:
    """Bands first, in a format that has no names for axes: recording it again would not help."""
    values = open_cube(small.header).read_rows(0, 128)
    np.save(tmp_path / "bands_first.npy", values.transpose(2, 0, 1))
    out = finished.copy_to(tmp_path / "out")
    error = run_refused(small.photos, tmp_path / "bands_first.npy", out)
    assert error["code"] == "markers_missing_in_cube"
    assert f"taken as {values.shape[2]} rows x {values.shape[0]} columns" in str(error["message"])
    assert str(error["advice"]).startswith("First check that")
    upside_down = header_edited(small, tmp_path / "order", "byte order = 0", "byte order = 1")
    plain = run_refused(small.photos, upside_down, out)
    assert plain["code"] == "markers_missing_in_cube"
    assert str(plain["advice"]).startswith("Record the cube again")
