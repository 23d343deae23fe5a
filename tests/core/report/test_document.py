"""The report as a page: what it says is what report.json holds, it stands alone, and odd results do not break it."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Literal
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest

from specimap_core.cloud import Cloud, CloudPoints
from specimap_core.errors import CloudDamagedError, NotFoundError
from specimap_core.export import export_cloud
from specimap_core.notices import Notice
from specimap_core.report.document import write_document
from specimap_core.report.maps import cube_frame, spacing_mm, top_raster
from specimap_core.report.model import Refused, Report
from tests.support.cloud_scene import scene
from tests.support.document_scene import Page, folder_of, full_report

HOSTILE = """<script>alert(1)</script>&"'$x^2_{$\u202e\x07ü.jpg"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return folder_of(tmp_path_factory.mktemp("document") / "out")


@pytest.fixture(scope="module")
def page(folder: Path) -> Page:
    return page_of(folder)


def page_of(folder: Path) -> Page:
    path = write_document(folder, folder.parent / "page.html", "html")
    return Page(path.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_it_stands_alone(page: Page) -> None:
    assert not {"script", "link", "iframe", "object", "embed", "form"} & page.tags
    assert page.links
    assert all(link.startswith("#") and link[1:] in page.ids for link in page.links)
    assert page.pictures()
    assert not re.findall(r"https?:|//[a-z]", re.sub(r'src="[^"]*"', "", page.text))


def test_every_picture_decodes_and_is_described(page: Page) -> None:
    kinds = []
    for (media, data), image in zip(page.pictures(), page.images, strict=True):
        wide, high = int(image["width"]), int(image["height"])
        kinds.append(media)
        if media == "image/svg+xml":
            tree = ElementTree.fromstring(data)
            box = tree.attrib["viewBox"].split()
            # Points of 1/72 inch in the file, pixels of 1/96 on the page.
            assert abs(float(box[2]) * 96 / 72 - wide) < 1
            assert abs(float(box[3]) * 96 / 72 - high) < 1
            assert not [v for e in tree.iter() for k, v in e.attrib.items() if k.endswith("href") and v[:1] != "#"]
        else:
            decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
            assert decoded is not None
            # Half as many pixels again as the page shows, for dense screens.
            assert abs(decoded.shape[1] / wide - 1.5) < 0.01
            assert abs(decoded.shape[0] / high - 1.5) < 0.01
            assert decoded.std() > 1
        assert len(image["alt"]) > 20
    assert set(kinds) == {"image/svg+xml", "image/png", "image/jpeg"}
    assert len(page.images) == 10
    assert page.text.startswith('<!DOCTYPE html>\n<html lang="en">')
    assert [text for tag, text in page.headings if tag == "h1"] == ["Accuracy report"]


def test_figures_are_those_of_the_report(folder: Path, page: Page) -> None:
    report = Report.model_validate_json((folder / "report.json").read_text(encoding="utf-8"))
    two = report.corner_2d_mm
    assert page.row("2D corner error") == [
        "2D corner error, mean ± sd",
        *2 * [f"{two.mean:.3f} ± {two.std:.3f}"],
        "0.013-0.017",
    ]
    assert page.row("3D corner error")[1] == "0.100 (0.050, 0.150)"
    assert page.row("Leaving a marker out, median")[1:] == ["0.021 (0.043)", "0.021 (0.043)", "–"]
    assert page.row("Stated sigma of")[1] == "0.100 (0.300)"
    assert page.row("Photos used")[1:3] == ["3 of 3", "all but 2"]
    assert page.row("Coverage between")[1:] == ["98.0 %", "above 97 %", "good"]
    assert page.row("adjust.edge_mm") == ["adjust.edge_mm", "6.8"]
    assert page.row("cube") == ["cube", "ab" * 32]
    assert "standard deviation of a point's position is 0.100 mm" in page.said
    for k, photo in enumerate(report.photo_corners or (), start=1):
        rms = np.sqrt((np.array(photo.residuals_px).reshape(-1, 2) ** 2).sum(1).mean())
        assert page.row(f"{k}")[1:] == [photo.name, "320 x 240", "0, 7", f"{rms:.3f}"]


@pytest.mark.slow
def test_hostile_names_are_text(tmp_path: Path) -> None:
    points = scene(70, 53)
    report = full_report(len(points), (HOSTILE, "b.jpg", "ç" * 200))
    refused = [Refused(name=f"2{HOSTILE}", code="photo_foreign", reason=HOSTILE)]
    report = report.model_copy(
        update={
            "photos": report.photos.model_copy(update={"refused": refused, "given": 4}),
            "warnings": [Notice(code="unheard_of", message=HOSTILE)],
            "settings": {HOSTILE: HOSTILE},
        }
    )
    page = page_of(folder_of(tmp_path / "out", report, points))
    assert "script" not in page.tags
    assert page.row("1")[1] == HOSTILE
    assert page.row(f"2{HOSTILE}")[1] == HOSTILE
    assert page.row(HOSTILE) == [HOSTILE, HOSTILE]
    assert page.said.count(HOSTILE) >= 5
    assert write_document(tmp_path / "out", tmp_path / "r.pdf", "pdf").read_bytes().startswith(b"%PDF-")


def test_a_report_of_an_older_version(tmp_path: Path) -> None:
    points = scene(70, 53)
    on_gpu = {
        "warnings": [Notice("dense_on_gpu", "By COLMAP's PatchMatch."), Notice("dense_gpu_failed", "Out of memory.")],
        "settings": {"reconstruct": {"depth": {"device": "gpu"}}},
    }
    old = folder_of(tmp_path / "out", full_report(len(points)).model_copy(update=on_gpu), points, old=True)
    (old / "preview.png").unlink()
    assert "photo_corners" not in json.loads((old / "report.json").read_text(encoding="utf-8"))
    page = page_of(old)
    assert "did not keep the corners in the photos" in page.said
    assert "a.jpg, b.jpg, c.jpg" in page.said
    assert len(page.images) == 7
    assert "By COLMAP's PatchMatch." in page.said
    assert "Out of memory." in page.said
    assert page.row("reconstruct.depth.device") == ["reconstruct.depth.device", "gpu"]


@pytest.mark.slow
@pytest.mark.parametrize("sheet", [b"", b"no jpeg", None])
def test_without_the_photos_their_outlines_stay(tmp_path: Path, sheet: bytes | None) -> None:
    out = folder_of(tmp_path / "out")
    if sheet is None:
        (out / "photos.jpg").unlink()
    else:
        (out / "photos.jpg").write_bytes(sheet)
    page = page_of(out)
    assert "photos themselves were not kept" in page.said
    assert len(page.images) == 10


@pytest.mark.slow
def test_a_stop_leaves_nothing(folder: Path, tmp_path: Path) -> None:
    class StopError(Exception):
        pass

    shares: list[float] = []

    def stop(share: float) -> None:
        shares.append(share)
        if share > 0.3:
            raise StopError

    for format in ("html", "pdf"):
        with pytest.raises(StopError):
            write_document(folder, tmp_path / f"r.{format}", format, progress=stop)
        assert 0 < shares[-1] < 0.6
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("format", ["html", "pdf"])
def test_the_same_run_gives_the_same_bytes_as_an_export_too(
    folder: Path, tmp_path: Path, format: Literal["html", "pdf"]
) -> None:
    cloud = Cloud.open(folder / "cloud.zarr")
    first = write_document(folder, tmp_path / f"first.{format}", format).read_bytes()
    assert first.startswith({"html": b"<!", "pdf": b"%PDF-"}[format])
    assert export_cloud(cloud, tmp_path / f"second.{format}", format).read_bytes() == first


def test_a_cloud_apart_from_its_report_has_no_document(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "bare").mkdir()
    (folder / "cloud.zarr").rename(tmp_path / "bare" / "cloud.zarr")
    try:
        with pytest.raises(NotFoundError):
            export_cloud(Cloud.open(tmp_path / "bare" / "cloud.zarr"), tmp_path / "x.html", "html")
    finally:
        (tmp_path / "bare" / "cloud.zarr").rename(folder / "cloud.zarr")


@pytest.mark.slow
def test_what_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="no report"):
        write_document(tmp_path, tmp_path / "r.html", "html")
    (tmp_path / "report.json").write_text("{}", encoding="utf-8")
    with pytest.raises(NotFoundError, match="not a report"):
        write_document(tmp_path, tmp_path / "r.html", "html")
    broken = folder_of(tmp_path / "broken")
    (broken / "cloud.zarr" / "sigma_mm" / "c" / "0").write_bytes(b"nothing that decodes")
    with pytest.raises(CloudDamagedError):
        write_document(broken, tmp_path / "r.html", "html")
    assert not (tmp_path / "r.html").exists()


# ---- odd results --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_nothing_known_of_anything(tmp_path: Path) -> None:
    points = scene(70, 53)
    points = replace(points, sigma_mm=np.full(len(points), np.nan, np.float32), flags=np.zeros_like(points.flags))
    report = full_report(len(points))
    nothing = report.corner_3d_mm.model_copy(update={"median": float("nan"), "q1": float("nan"), "q3": float("nan")})
    methods = {
        name: m.model_copy(update={"corner_3d_mm": nothing, "leave_one_marker_out_mm": None})
        for name, m in report.methods.items()
    }
    report = report.model_copy(update={"corner_3d_mm": nothing, "leave_one_marker_out_mm": None, "methods": methods})
    page = page_of(folder_of(tmp_path / "out", report, points))
    assert page.row("3D corner error")[1] == "– (–, –)"
    assert page.row("Leaving a marker out")[1] == "too few markers to tell"
    assert "No marker could be left out" in page.said


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_hardly_any_points(tmp_path: Path, count: int) -> None:
    few = CloudPoints(**{name: values[:count] for name, values in vars(scene(70, 53)).items()})
    assert len(page_of(folder_of(tmp_path / "out", None, few)).images) == 10


@pytest.mark.slow
def test_a_photo_without_markers(tmp_path: Path) -> None:
    report = full_report(10)
    bare = [
        photo.model_copy(update={"marker_ids": [], "corners_px": [], "residuals_px": []})
        for photo in report.photo_corners or ()
    ]
    some = folder_of(
        tmp_path / "some", report.model_copy(update={"photo_corners": [*(report.photo_corners or ()), *bare[:1]]})
    )
    assert page_of(some).row("4")[3:] == ["none", "–"]
    none = folder_of(tmp_path / "none", report.model_copy(update={"photo_corners": bare}))
    assert len(page_of(none).images) == 10


# ---- maps ---------------------------------------------------------------------------------------------


def test_maps_hold_the_points_where_they_belong(folder: Path) -> None:
    cloud = Cloud.open(folder / "cloud.zarr")
    frame = cube_frame(cloud, (70, 53))
    shown = frame.mean(cloud.sigma_mm)
    np.testing.assert_array_equal(shown[cloud.hsi_pixel[:, 0], cloud.hsi_pixel[:, 1]], cloud.sigma_mm)
    assert np.isfinite(shown).sum() == cloud.n_points
    # The scene has 0.1 mm a pixel; float32 places give it to their own precision.
    assert abs(spacing_mm(cloud) - 0.1) < 1e-5
    above = top_raster(cloud)
    known = np.isfinite(above.height_mm)
    assert known.mean() > 0.8
    assert above.height_mm[known].min() >= cloud.xyz[:, 2].min() - 1e-5
    assert above.height_mm[known].max() <= cloud.xyz[:, 2].max() + 1e-5
    left, right, bottom, top = above.extent_mm
    rows, cols = above.height_mm.shape
    assert abs((right - left) / cols - above.grid_mm) < 1e-6
    assert abs((top - bottom) / rows - above.grid_mm) < 1e-6


def test_large_cubes_are_reduced(folder: Path) -> None:
    cloud = Cloud.open(folder / "cloud.zarr")
    frame = cube_frame(cloud, (1280, 1024))
    assert (frame.rows, frame.cols, frame.step) == (640, 512, 2)
    assert abs(frame.mm_per_px - 2 * spacing_mm(cloud)) < 1e-9
    shown = frame.mean(cloud.sigma_mm)
    in_first = (cloud.hsi_pixel // 2 == 0).all(1)
    assert abs(float(shown[0, 0]) - float(cloud.sigma_mm[in_first].mean())) < 1e-6
