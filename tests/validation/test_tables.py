"""Evidence: finding acquisitions, choosing photos, judging against truth, tables and marks in pages."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from specimap_core.cloud import Cloud
from specimap_core.errors import CubeNotFoundError, NotFoundError, SettingsError, TooFewPhotosError
from specimap_core.progress import within
from specimap_core.report import published
from specimap_core.truth.judge import judge, judge_with_sigma
from specimap_validation.capture import find_capture
from specimap_validation.page_marks import check_marks, put
from specimap_validation.photo_subsets import even_subset, random_subset
from specimap_validation.runs import STAGE_SHARES, figures_of
from specimap_validation.tables import Table
from tests.support.scenes import Finished, OnDisk

# ---- acquisitions -------------------------------------------------------------------------------------


def folder_with(folder: Path, *files: str) -> Path:
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"x")
    return folder


@pytest.mark.parametrize(
    ("files", "cube", "truth"),
    [
        (("rgb/a.jpg", "hsi/hsi.hdr", "hsi/hsi.raw", "truth.npz"), "hsi/hsi.hdr", True),
        (("photos/a.png", "hsi/scan 7.hdr"), "hsi/scan 7.hdr", False),
        (("rgb/a.jpg", "cube.hdr", "cube.raw"), "cube.hdr", False),
        (("rgb/a.jpg", "cube.npy"), "cube.npy", False),
    ],
)
def test_an_acquisition_is_found_in_its_folder(tmp_path: Path, files: tuple[str, ...], cube: str, truth: bool) -> None:
    found = find_capture(folder_with(tmp_path / "SP 1", *files))
    assert found.cube == tmp_path / "SP 1" / cube
    assert [p.name for p in found.photos] == [Path(files[0]).name]
    assert found.has_truth == truth
    assert found.name == "SP 1"


def test_what_is_no_acquisition_is_refused(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no folder"):
        find_capture(tmp_path / "absent")
    with pytest.raises(NotFoundError, match="no folder of photos"):
        find_capture(folder_with(tmp_path / "a", "hsi/hsi.hdr"))
    with pytest.raises(CubeNotFoundError, match="no cube"):
        find_capture(folder_with(tmp_path / "b", "rgb/a.jpg", "hsi/hsi.raw"))
    with pytest.raises(CubeNotFoundError, match="2 cubes"):
        find_capture(folder_with(tmp_path / "c", "rgb/a.jpg", "hsi/1.hdr", "hsi/2.hdr"))
    with pytest.raises(TooFewPhotosError):
        find_capture(folder_with(tmp_path / "d", "rgb/notes.txt", "hsi/1.hdr"))


def test_a_share_of_the_photos_is_spread_or_random_and_repeats() -> None:
    photos = [Path(f"{k:02d}.jpg") for k in range(24)]
    assert even_subset(photos, 0.5) == photos[1::2]
    first = random_subset(photos, 0.8, 1)
    assert len(first) == len(set(first)) == 19
    assert first == sorted(first) == random_subset(photos, 0.8, 1)
    assert first != random_subset(photos, 0.8, 2)
    assert random_subset(photos, 1.0, 5) == photos


# ---- judging ------------------------------------------------------------------------------------------


def test_a_run_is_judged_with_its_own_sigma(finished: Finished, small: OnDisk) -> None:
    judged = judge_with_sigma(finished.out, small.folder)
    plain = judge(finished.out, small.folder)
    np.testing.assert_array_equal(judged.errors.errors_mm, plain.errors_mm)
    assert judged.sigma_mm.shape == plain.errors_mm.shape
    cloud, truth = Cloud.open(finished.out / "cloud.zarr"), small.truth
    on_it = truth.hsi_class[cloud.hsi_pixel[:, 0], cloud.hsi_pixel[:, 1]] == 1
    np.testing.assert_array_equal(judged.sigma_mm, cloud.sigma_mm[on_it])
    assert 0.3 < judged.within(1) < judged.within(2) < judged.within(3) < 1
    assert judged.within(1e6) == 1.0


def test_figures_of_a_run_are_those_of_its_report(finished: Finished, small: OnDisk) -> None:
    found = figures_of(finished.report, finished.out, small.folder)
    assert found.photos_used == found.photos_given == 12
    assert found.corner_2d_mm == finished.report.corner_2d_mm
    assert found.corner_3d_mm == finished.report.corner_3d_mm
    assert found.seconds == pytest.approx(sum(finished.report.seconds.values()), abs=0.01)
    assert found.truth is not None
    assert 0.01 < found.truth.median_mm < 0.25 < 0.97 < found.truth.coverage <= 1
    assert figures_of(finished.report, finished.out, None).truth is None
    assert json.loads(found.model_dump_json())["truth"]["scale"] == found.truth.scale


def test_progress_of_a_part_is_progress_of_the_whole() -> None:
    heard: list[float] = []
    part = within(within(heard.append, 0.5, 1.0), 0.0, 0.5)
    part(0.0)
    part(1.0)
    assert heard == [0.5, 0.75]
    assert sum(STAGE_SHARES.values()) == pytest.approx(1)


# ---- words --------------------------------------------------------------------------------------------


def test_published_figures_in_words() -> None:
    assert published.CORNER_2D_WORDS == "0.013-0.017"
    assert published.CORNER_3D_WORDS == "0.945-0.974"
    assert published.STAGE_SECONDS_WORDS == {"reconstruct": "178-210", "register": "24-25"}
    low, high = published.TOTAL_SECONDS
    assert (low, high) == (178 + 24, 210 + 24), "the whole is its stages"


def test_a_table_is_markdown() -> None:
    table = Table("t", ("a", "b"), (("1", "-"), ("x y", "2")))
    assert table.markdown().splitlines() == ["| a | b |", "|---|---|", "| 1 | - |", "| x y | 2 |"]


def test_text_goes_between_the_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- v -->\nold\nold\n<!-- /v -->\nafter <!-- w -->\n<!-- /w -->\n", "utf-8")
    put(page, "v", r"new \1 {x}")
    assert page.read_text("utf-8") == ("before\n<!-- v -->\nnew \\1 {x}\n<!-- /v -->\nafter <!-- w -->\n<!-- /w -->\n")
    put(page, "w", "more")
    assert "<!-- w -->\nmore\n<!-- /w -->" in check_marks(page, "w")
    for text in ("no mark", "<!-- v -->\n<!-- /v -->\n<!-- v -->\n<!-- /v -->\n"):
        page.write_text(text, "utf-8")
        with pytest.raises(SettingsError, match="places marked v"):
            put(page, "v", "x")
        assert page.read_text("utf-8") == text
    with pytest.raises(SettingsError, match="no page"):
        put(tmp_path / "absent.md", "v", "x")
