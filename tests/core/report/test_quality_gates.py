"""A run whose figures show that it failed says so, in warnings and verdict alike, or is refused."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from specimap_core.errors import RegistrationError, ResultInsufficientError
from specimap_core.geometry.cameras import look_at
from specimap_core.reconstruct.backend import CornersInPhotos
from specimap_core.reconstruct.pose_check import outlier_photos
from specimap_core.report.model import PhotoCorners, Report
from specimap_core.report.quality_gates import gated, outlying_photos
from specimap_core.report.wording import GRAVE, WARNING_ADVICE, checks, verdict
from tests.support.broken_sets import card_moved, copied, sheared
from tests.support.document_scene import full_report, square
from tests.support.scenes import EDGE_MM, Finished, OnDisk, marker_scene, run_refused, specimap

# ---- figures ------------------------------------------------------------------------------------------


def photo(name: str, off: float, *, width: int = 640) -> PhotoCorners:
    """Two markers, all corners ``off`` px off to the right."""
    return PhotoCorners(
        name=name,
        width_px=width,
        height_px=480,
        marker_ids=[0, 7],
        corners_px=[square(30, 30), square(200, 150)],
        residuals_px=[[off, 0.0] * 4, [off, 0.0] * 4],
    )


def report(**changes: Any) -> Report:
    """A report without fault but for ``changes`` of sections' fields, named section__field."""
    plain = full_report(10)
    for name, value in changes.items():
        section, _, field = name.partition("__")
        new = getattr(plain, section).model_copy(update={field: value}) if field else value
        plain = plain.model_copy(update={section: new})
    return plain


def codes(found: Report) -> set[str]:
    return {w.code for w in found.warnings}


def test_figures_in_order_call_for_nothing() -> None:
    assert codes(gated(report(), EDGE_MM)) == set()
    assert verdict(gated(report(), EDGE_MM)).level == "good"


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"coverage__between_markers": 0.96}, "coverage_low"),
        ({"coverage__between_markers": float("nan")}, None),
        ({"coverage__specimen_points": 0}, "specimen_not_found"),
        ({"reprojection_px__after": 0.81}, "corners_scatter"),
        ({"reprojection_px__after": float("nan")}, "corners_scatter"),
        ({"cube_camera__reprojection_rms_px": 1.1}, "cube_corners_scatter"),
        ({"photo_corners": [photo(f"{k}.jpg", 0.1) for k in range(5)] + [photo("off.jpg", 1.3)]}, "photo_outlying"),
    ],
)
def test_each_figure_beyond_its_limit_is_said_twice(changes: dict[str, Any], code: str | None) -> None:
    if code is None:
        with pytest.raises(ResultInsufficientError):
            gated(report(**changes), EDGE_MM)
        return
    found = gated(report(**changes), EDGE_MM)
    assert codes(found) == {code}
    output = verdict(found)
    assert output.level == "attention"
    assert output.actions
    assert WARNING_ADVICE[code]
    failed = [c for c in checks(found) if not c.good]
    assert failed or code in GRAVE


@pytest.mark.parametrize(
    "changes",
    [
        {"coverage__between_markers": 0.98},
        {"reprojection_px__after": 0.79},
        {"cube_camera__reprojection_rms_px": 0.95},
        {"photo_corners": [photo(f"{k}.jpg", 0.3) for k in range(5)] + [photo("off.jpg", 1.1)]},
        {"photo_corners": [photo(f"{k}.jpg", 0.5) for k in range(5)] + [photo("off.jpg", 2.9)]},
        {"photo_corners": None},
    ],
)
def test_figures_within_their_limits_are_not_complained_of(changes: dict[str, Any]) -> None:
    assert codes(gated(report(**changes), EDGE_MM)) == set()


def test_limits_grow_with_photos_larger_than_usual() -> None:
    large = [photo(f"{k}.jpg", 0.2, width=5120) for k in range(5)] + [photo("off.jpg", 4.0, width=5120)]
    assert codes(gated(report(photo_corners=large, reprojection_px__after=3.0), EDGE_MM)) == set()
    assert codes(gated(report(photo_corners=large, reprojection_px__after=3.3), EDGE_MM)) == {"corners_scatter"}


def test_outlying_photos_are_named_with_their_worst_marker() -> None:
    off = photo("card.jpg", 0.1).model_copy(update={"residuals_px": [[0.1, 0.0] * 4, [50.0, 0.0] * 4]})
    (found,) = outlying_photos(report(photo_corners=[*(photo(f"{k}.jpg", 0.1) for k in range(4)), off]))
    assert (found.name, found.marker) == ("card.jpg", 7)
    assert found.px == pytest.approx(50 / 2**0.5, rel=1e-3)
    assert found.marker_px == pytest.approx(50)


@pytest.mark.parametrize(
    "changes",
    [
        {"coverage__between_markers": 0.012, "coverage__specimen_points": 0},
        {"coverage__between_markers": 0.09},
        {"coverage__between_markers": 0.4, "coverage__specimen_points": 0},
    ],
)
def test_too_little_to_be_of_use_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ResultInsufficientError) as refused:
        gated(report(**changes), EDGE_MM)
    assert "20 or more sharp photos" in refused.value.advice
    assert refused.value.details["between_markers"] == changes["coverage__between_markers"]
    with pytest.raises(ResultInsufficientError) as moved:
        gated(report(**changes, reprojection_px__after=3.0), EDGE_MM)
    assert "contradict each other" in moved.value.advice


def test_a_cube_of_other_markers_is_refused() -> None:
    far = report().corner_2d_mm.model_copy(update={"mean": 3.5})
    with pytest.raises(RegistrationError, match=r"elsewhere in the cube .* by 3\.5 mm"):
        gated(report(corner_2d_mm=far), EDGE_MM)


# ---- photos that contradict the rest --------------------------------------------------------------------


@pytest.mark.parametrize("moved", [{}, {4: 9.0}, {4: 9.0, 7: -12.0}, {0: 40.0}])
def test_photos_tens_of_pixels_off_are_strays(moved: dict[int, float]) -> None:
    """A layout that ten cameras see; some are posed so many mm from where they stood."""
    truth, seen = marker_scene(noise_px=0.1)
    poses = dict(enumerate(truth.poses))
    for k, mm in moved.items():
        aside = np.array([mm, 0.0, 0.0])
        poses[k] = look_at(poses[k].centre + aside, aside, np.array([0.0, 0, 1]))
    found = outlier_photos(truth.lens, poses, CornersInPhotos(seen, (0, 1, 2, 3)))
    assert set(found) == set(moved)
    assert all(20 < px < 400 for px in found.values())
    # Photos that show no marker are not judged.
    blind = CornersInPhotos(seen.of(~np.isin(seen.photo, list(moved))), (0, 1, 2, 3))
    assert outlier_photos(truth.lens, poses, blind) == {}


# ---- whole runs -----------------------------------------------------------------------------------------


def test_a_run_in_order_has_no_such_warning(finished: Finished) -> None:
    assert codes(finished.report) <= {"few_photos", "markers_not_in_band_mean"}


def ran(photos: Path, cube: Path, out: Path) -> Report:
    answer = specimap("run", "--photos", photos, "--cube", cube, "--out", out, "--json")
    assert answer.status == 0
    return Report.model_validate(answer.events[-1]["report"])


@pytest.mark.slow
def test_a_card_that_moved_in_one_photo_is_named(small: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    (name,) = card_moved(small, photos, marker=2, by_mm=(2.0, 0.0), photos=slice(0, 1))
    found = ran(photos, small.header, tmp_path / "out")
    (output,) = [w.message for w in found.warnings if w.code == "photo_outlying"]
    assert f"{name} " in output
    assert "marker 2" in output
    assert verdict(found).level == "attention"
    # The adjustment is robust: the result itself holds.
    assert found.corner_2d_mm.mean < 0.1


@pytest.mark.slow
def test_a_card_that_moved_between_photos_is_said(small: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    card_moved(small, photos, marker=2, by_mm=(2.0, 0.0), photos=slice(0, 6))
    assert "corners_scatter" in codes(ran(photos, small.header, tmp_path / "out"))


@pytest.mark.slow
def test_a_card_that_moved_far_between_photos_is_refused(small: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    card_moved(small, photos, marker=2, by_mm=(5.0, 3.0), photos=slice(0, 6))
    out = tmp_path / "out"
    refusal = run_refused(photos, small.header, out)
    assert refusal["code"] == "result_insufficient"
    assert "contradict each other" in str(refusal["advice"])
    assert not (out / "report.json").exists()


@pytest.mark.slow
def test_photos_from_one_side_are_said_to_leave_holes(small: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    for path in sorted(photos.iterdir())[6:]:
        path.unlink()
    assert "coverage_low" in codes(ran(photos, small.header, tmp_path / "out"))


@pytest.mark.slow
def test_the_cube_of_another_layout_is_refused(
    small: OnDisk, other: OnDisk, finished: Finished, tmp_path: Path
) -> None:
    out = finished.copy_to(tmp_path / "out")
    refusal = run_refused(small.photos, other.header, out)
    assert refusal["code"] == "registration_failed"
    assert "elsewhere in the cube than in the photos" in str(refusal["message"])


@pytest.mark.slow
def test_a_photo_of_elsewhere_is_left_out_and_a_sheared_one_named(small: OnDisk, other: OnDisk, tmp_path: Path) -> None:
    photos = copied(small.photos, tmp_path / "photos")
    shutil.copy(other.photos / "view_004.jpg", photos / "elsewhere.jpg")
    sheared(photos / "view_003.jpg", 10)
    found = ran(photos, small.header, tmp_path / "out")
    assert [r.name for r in found.photos.refused] == ["elsewhere.jpg"]
    assert codes(found) <= {"few_photos", "markers_not_in_band_mean", "focal_breathing", "photo_contradicts"}
    assert found.certificate is not None
    assert found.certificate.surface.photos_off == ("view_003.jpg",)
    (named,) = [w.message for w in found.warnings if w.code == "photo_contradicts"]
    assert "view_003.jpg" in named
