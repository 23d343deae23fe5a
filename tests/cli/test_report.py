"""``specimap report`` on a whole run: its own sections in report.json, the page, the PDF, and truth."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from specimap_cli.report import report as report_command
from specimap_core.arrays import Floats
from specimap_core.photos.contact_sheet import read_tiles
from specimap_core.pipeline.outputs import Outputs
from specimap_core.report.model import PhotoCorners, Report
from specimap_core.truth.judge import judge
from tests.support.document_scene import Page
from tests.support.scenes import Answer, Finished, OnDisk

ROUNDED_PX = 0.005
CORNERS_ROUNDED_PX = 0.05


def command(*arguments: object) -> Answer:
    """Run the command in this process."""
    app = typer.Typer(pretty_exceptions_enable=False)
    app.command()(report_command)
    result = CliRunner().invoke(app, [str(a) for a in arguments])
    assert "Traceback" not in result.output
    return Answer(result.exit_code, result.stdout, result.stderr)


def photos_of(finished: Finished) -> tuple[Report, list[PhotoCorners]]:
    report = Report.model_validate_json(Outputs(finished.out).report.read_text(encoding="utf-8"))
    assert report.photo_corners is not None
    return report, report.photo_corners


def residuals(photos: list[PhotoCorners]) -> Floats:
    return np.concatenate([np.array(p.residuals_px, float).reshape(-1, 2) for p in photos])


# ---- what the run leaves ------------------------------------------------------------------------------


def test_the_report_holds_the_corners(finished: Finished, small: OnDisk) -> None:
    report, photos = photos_of(finished)
    assert report.text() == finished.report.text() == Outputs(finished.out).report.read_text(encoding="utf-8")
    assert [photo.name for photo in photos] == report.photos.used
    lengths = np.linalg.norm(residuals(photos), axis=1)
    # Both coordinates are rounded: no length is off by more than that, nor is their root mean square.
    assert abs(np.sqrt((lengths**2).mean()) - report.reprojection_px.after) <= np.sqrt(2) * ROUNDED_PX
    assert lengths.max() > ROUNDED_PX
    views = dict(zip((Path(n).name for n in small.truth.photo_names), small.truth.views, strict=True))
    true_corners = dict(zip(small.truth.marker_ids.tolist(), small.truth.marker_corners, strict=True))
    away = []
    for photo in photos:
        for marker_id, corners in zip(photo.marker_ids, photo.corners_px, strict=True):
            true = views[photo.name].project(true_corners[marker_id])
            away.append(np.abs(np.array(corners).reshape(4, 2) - true).max())
    # Corners are measured to a few tenths of a pixel here; a wrong order would be a marker's edge away.
    assert ROUNDED_PX < np.median(away) < 0.5 + CORNERS_ROUNDED_PX


def test_the_cube_s_corners_are_as_stored(finished: Finished, small: OnDisk) -> None:
    report, _ = photos_of(finished)
    cube = report.cube_corners
    assert cube is not None
    assert (cube.rows, cube.cols) == small.truth.hsi_class.shape
    assert cube.marker_ids == report.marker_ids_in_cube
    true_corners = dict(zip(small.truth.marker_ids.tolist(), small.truth.marker_corners, strict=True))
    true = small.truth.hsi_view.project(np.stack([true_corners[i] for i in cube.marker_ids]))
    assert np.median(np.abs(np.array(cube.corners_px).reshape(-1, 4, 2) - true)) < 0.5
    lengths = np.linalg.norm(np.array(cube.residuals_px).reshape(-1, 2), axis=1)
    assert abs(np.sqrt((lengths**2).mean()) - report.cube_camera.reprojection_rms_px) <= np.sqrt(2) * ROUNDED_PX


def test_the_tiles_show_the_photos(finished: Finished, small: OnDisk) -> None:
    import cv2

    _, photos = photos_of(finished)
    first = photos[0]
    tiles = read_tiles(Outputs(finished.out).sheet.read_bytes(), len(photos), first.width_px, first.height_px)
    for tile, photo in zip(tiles, photos, strict=True):
        image = cv2.imread(str(small.photos / photo.name))
        assert image is not None
        shrunk = cv2.resize(image, tile.shape[1::-1], interpolation=cv2.INTER_AREA)[..., ::-1].astype(int)
        own = np.abs(tile - shrunk).mean()
        others = [np.abs(other.astype(int) - shrunk).mean() for other in tiles if other is not tile]
        assert own < min(others) / 2


def test_the_cloud_s_attributes_stay_small(finished: Finished) -> None:
    attributes = json.loads((Outputs(finished.out).cloud / "zarr.json").read_text(encoding="utf-8"))["attributes"]
    assert "photo_corners" not in attributes["report"]
    assert attributes["report"]["photos"] == json.loads(finished.report.photos.model_dump_json())


# ---- the command --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_page_with_truth(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    answer = command(finished.out, "--truth", small.folder, "--target", target, "--json")
    assert answer.status == 0
    assert json.loads(answer.out) == {"event": "reported", "path": str(target)}
    page = Page(target.read_text(encoding="utf-8"))
    found = judge(finished.out, small.folder)
    assert page.row("Median error")[1] == f"{found.median:.3f} mm"
    assert page.row("95 % of the errors")[1] == f"{found.p95:.3f} mm"
    assert page.row("Pixels of the specimen")[1] == f"{100 * found.coverage:.2f} %"
    within = page.row("Errors within one stated sigma")[1]
    assert 0 < float(within.removesuffix(" %")) < 100
    assert f"median error is {found.median:.3f} mm" in page.said
    plain = command(finished.out, "--target", tmp_path / "plain.html")
    assert plain.out == f"Wrote {tmp_path / 'plain.html'}\n"
    without = Page((tmp_path / "plain.html").read_text(encoding="utf-8"))
    assert len(page.images) == len(without.images) + 2
    assert "truth" not in without.ids


@pytest.mark.slow
def test_a_pdf(finished: Finished, tmp_path: Path) -> None:
    out = finished.copy_to(tmp_path / "out")
    answer = command(out, "--format", "pdf")
    assert answer.out == f"Wrote {out / 'report.pdf'}\n"
    data = (out / "report.pdf").read_bytes()
    assert data.startswith(b"%PDF-1.")
    assert data.rstrip().endswith(b"%%EOF")
    pages = len(re.findall(rb"/Type /Page\b", data))
    assert 5 <= pages <= 20
    assert len(re.findall(rb"/Subtype /Image\b", data)) >= 10


@pytest.mark.skipif(shutil.which("pdftotext") is None, reason="pdftotext (poppler-utils) is not installed")
def test_what_the_pdf_says(finished: Finished, tmp_path: Path) -> None:
    target = tmp_path / "r.pdf"
    assert command(finished.out, "--format", "pdf", "--target", target).status == 0
    described = subprocess.run(
        ["pdftotext", "-layout", target, "-"], capture_output=True, text=True, check=True, timeout=60
    )
    text = " ".join(described.stdout.split())
    report = finished.report
    for output in (
        "Accuracy report",
        "Verdict",
        "For research use only. Not a medical device",
        f"{report.corner_2d_mm.mean:.3f} ± {report.corner_2d_mm.std:.3f}",
        f"{report.leave_one_marker_out_mm.median:.3f} ({report.leave_one_marker_out_mm.maximum:.3f})"
        if report.leave_one_marker_out_mm
        else "No marker could be left out",
        f"{len(report.photos.used)} of {report.photos.given}",
        report.photos.used[-1],
        "adjust.edge_mm",
    ):
        assert output in text


def test_what_is_refused(finished: Finished, small: OnDisk, tmp_path: Path) -> None:
    answer = command(tmp_path, "--json")
    assert (answer.status, answer.refusal["code"]) == (2, "not_found")
    answer = command(finished.out, "--truth", tmp_path, "--target", tmp_path / "x.html", "--json")
    assert (answer.status, answer.refusal["code"]) == (2, "not_found")
    other = tmp_path / "other"
    other.mkdir()
    with np.load(small.folder / "truth.npz") as held:
        arrays = dict(held)
    np.savez(other / "truth.npz", **{**arrays, "marker_ids": arrays["marker_ids"] + 20})
    answer = command(finished.out, "--truth", other, "--target", tmp_path / "x.html", "--json")
    assert (answer.status, answer.refusal["code"]) == (2, "setting_invalid")
    assert not (tmp_path / "x.html").exists()
