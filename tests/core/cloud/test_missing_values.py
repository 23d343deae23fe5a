"""Points without a value: what pictures, exports, answers and the search for markers make of them."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import cv2
import httpx
import numpy as np
import pyarrow as pa
import pytest
from PIL import Image

from specimap_client._models import Point
from specimap_core.arrays import Array
from specimap_core.cloud import Cloud, Flag
from specimap_core.cloud.preview import write_preview
from specimap_core.cloud.writer import write_cloud
from specimap_core.cube import open_cube
from specimap_core.export import export_cloud
from specimap_core.register.cube_markers import cleaned, find_in_image
from specimap_service.array_responses import ARROW, NPY
from tests.support.cloud_scene import FakeCube, scene
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running

ROWS, COLS, BANDS = 40, 36, 5


def values() -> Array:
    """Reflectance from -0.05 to 0.9; a block without any value, one without the band 2."""
    rng = np.random.default_rng(1)
    image = rng.uniform(-0.05, 0.9, (ROWS, COLS, BANDS)).astype(np.float32)
    image[:8, :10] = np.nan
    image[20:24, 5:9, 2] = np.nan
    return image


def cube() -> FakeCube:
    return FakeCube(values(), to_reflectance=1.0)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Cloud:
    path = tmp_path_factory.mktemp("missing") / "c.zarr"
    write_cloud(path, scene(ROWS, COLS, 1.0), cube(), {})
    return Cloud.open(path)


def of_points(cloud: Cloud, image: Array) -> Array:
    row, col = cloud.hsi_pixel.astype(int).T
    return np.asarray(image[row, col])


# ---- exports ------------------------------------------------------------------------------------------


def test_tables(cloud: Cloud, tmp_path: Path) -> None:
    right = of_points(cloud, values())
    with open(export_cloud(cloud, tmp_path / "c.csv", "csv"), newline="", encoding="ascii") as file:
        _, *rows = csv.reader(file)
    table = np.array(rows, float)
    np.testing.assert_allclose(table[:, 13:], right, rtol=0, atol=0.51e-4)
    assert ((table[:, 10].astype(int) & Flag.NO_DATA > 0) == np.isnan(right).any(1)).all()
    with np.load(export_cloud(cloud, tmp_path / "c.npz", "npz")) as held:
        decoded = held["spectra"] * float(held["scale_factor"]) + float(held["add_offset"])
        decoded[held["spectra"] == held["fill_value"]] = np.nan
    np.testing.assert_allclose(decoded, right, rtol=0, atol=0.51e-4)


@pytest.mark.parametrize("grid_mm", [0.1, 0.35])
def test_an_envi_export_is_read_back(cloud: Cloud, tmp_path: Path, grid_mm: float) -> None:
    """Means leave out what is missing; our own reader gives reflectance and NaN again."""
    path = export_cloud(cloud, tmp_path / "top", "envi", grid_mm=grid_mm)
    again = open_cube(path)
    assert again.quantity == "reflectance"
    got = (again.read_rows(0, again.rows) * (again.to_reflectance or 0))[::-1]
    spectra = cloud.spectra(slice(None)).astype(float)
    col, row = np.rint((cloud.xyz[:, :2] - cloud.xyz[:, :2].min(0)) / np.float32(grid_mm)).astype(int).T
    total, count = np.zeros(got.shape), np.zeros(got.shape)
    known = np.isfinite(spectra)
    top = np.full(got.shape[:2], -np.inf)
    np.maximum.at(top, (row, col), cloud.xyz[:, 2])
    seen = cloud.xyz[:, 2] >= top[row, col] - 1
    np.add.at(total, (row[seen], col[seen]), np.where(known, spectra, 0)[seen])
    np.add.at(count, (row[seen], col[seen]), known[seen])
    want = total / np.where(count > 0, count, np.nan)
    assert 0 < np.isnan(want).mean() < 0.5
    np.testing.assert_allclose(got, want, rtol=0, atol=0.51e-4)


# ---- pictures -----------------------------------------------------------------------------------------


def test_the_preview_leaves_out_what_has_no_spectrum(tmp_path: Path) -> None:
    image = values()
    image[20:24, 5:9] = 0.5
    image[20:24, 5:9, 2] = np.nan
    plain = np.where(np.isnan(image), np.float32(0.5), image)
    pictures = []
    for name, content in (("holes", image), ("plain", plain)):
        write_cloud(tmp_path / name, scene(ROWS, COLS, 1.0), FakeCube(content, to_reflectance=1.0), {})
        write_preview(Cloud.open(tmp_path / name), tmp_path / f"{name}.png")
        shown = cv2.imread(str(tmp_path / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        assert shown is not None
        pictures.append(shown.astype(int))
    holes, whole = pictures
    assert (whole[..., 3] == 255).all()
    assert (holes[:5, :7, 3] == 0).all()  # two cells at the border are filled
    assert (holes[9:, 11:, 3] == 255).all()
    assert (holes[20:24, 5:9, 3] == 255).all()
    # One band of five is missing there: the other four still tell the colour.
    assert np.abs(holes[20:24, 5:9, :3] - whole[20:24, 5:9, :3]).mean() < 40


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result", cube=cube(), points=scene(ROWS, COLS, 1.0))


@pytest.fixture
def reader(service: Running, result: Result) -> httpx.Client:
    client = service.client(["read"])
    client.base_url = client.base_url.join(f"/v1/clouds/{result.cloud_id}/")
    return client


@pytest.mark.parametrize("asked", ["band.png?b=2", "composite.png?r=2&g=1&b=0", "index.png?a=2&b=1"])
def test_pictures_are_transparent_there(reader: httpx.Client, asked: str) -> None:
    answer = reader.get(f"previews/{asked}")
    assert answer.status_code == 200
    alpha = np.asarray(Image.open(io.BytesIO(answer.content)).convert("RGBA"))[..., 3]
    lacking = np.isnan(values()[..., [2, 1]]).any(-1)
    assert (alpha[lacking] == 0).all()
    if not asked.startswith("index"):
        assert (alpha[~lacking] == 255).all()
    if asked.startswith("band"):
        limits = [float(limit) for limit in answer.headers["x-specimap-range"].split(",")]
        np.testing.assert_allclose(limits, np.nanpercentile(values()[..., 2], [2, 98]), atol=2e-4)


# ---- answers ------------------------------------------------------------------------------------------


def test_answers_say_null_or_nan(reader: httpx.Client, result: Result) -> None:
    cloud = result.cloud
    right = of_points(cloud, values())
    lacking = np.flatnonzero(np.isnan(right[:, 2]) & ~np.isnan(right[:, 1]))[:3].tolist()
    asked = {"select": {"indices": lacking}}
    described = reader.post("spectra", json=asked).json()["spectra"]
    assert [row[2] for row in described] == [None] * 3
    np.testing.assert_allclose(np.array(described, float), right[lacking], rtol=0, atol=0.51e-4)
    npy = np.load(io.BytesIO(reader.post("spectra", json=asked, headers={"Accept": NPY}).content))
    np.testing.assert_allclose(npy, right[lacking], rtol=0, atol=0.51e-4)
    with pa.ipc.open_stream(reader.post("spectra", json=asked, headers={"Accept": ARROW}).content) as stream:
        column = np.stack(stream.read_all().column("spectrum").to_numpy())
    np.testing.assert_allclose(column, right[lacking], rtol=0, atol=0.51e-4)
    band = reader.get("bands/2").json()["values"]
    np.testing.assert_allclose(np.array(band, float), right[:, 2], rtol=0, atol=0.51e-4)
    shown = reader.get(f"points/{lacking[0]}").json()
    assert "no_data" in shown["flag_names"]
    point = Point.of(shown)
    assert np.isnan(point.spectrum[2])
    assert point.spectrum[1] == pytest.approx(float(right[lacking[0], 1]), abs=0.51e-4)


# ---- the image that markers are sought in -------------------------------------------------------------


def marker_image() -> Array:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    image = np.full((160, 200), 0.6, np.float32)
    for i, (row, col) in enumerate(((20, 30), (20, 120), (90, 30), (90, 120))):
        marker = cv2.aruco.generateImageMarker(dictionary, i, 48).astype(np.float32) / 255
        image[row : row + 48, col : col + 48] = 0.05 + 0.75 * marker
    noise = np.random.default_rng(0).normal(0, 0.01, image.shape)
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7) + noise, np.float32)


def test_dead_pixels_and_columns_do_not_show_in_the_image_for_registration() -> None:
    plain = marker_image()
    spoilt = plain.copy()
    spoilt[:, [40, 140]] = np.nan
    spoilt[:, 170:173] = np.nan
    spoilt[60, 60], spoilt[100, 33] = 1e6, -1e6
    found = cleaned(spoilt)
    assert np.isfinite(found).all()
    untouched = np.isfinite(spoilt) & (np.abs(spoilt) < 1e5)
    np.testing.assert_array_equal(found[untouched], plain[untouched])
    # Between neighbours, so that only a marker's edges differ.
    assert np.abs(found - plain)[:, [40, 140]].mean() < 0.05
    corners = {d.marker_id: d.corners_px for d in find_in_image(found, "DICT_4X4_50", (0, 1, 2, 3))}
    for detection in find_in_image(plain, "DICT_4X4_50", (0, 1, 2, 3)):
        assert np.abs(corners[detection.marker_id] - detection.corners_px).max() < 0.15
    assert len(corners) == 4


def test_large_parts_without_a_value_stay_unknown() -> None:
    image = marker_image()
    image[:15] = np.nan
    image[:, -9:] = np.nan
    found = cleaned(image)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(image))
    assert {d.marker_id for d in find_in_image(found, "DICT_4X4_50", (0, 1, 2, 3))} == {0, 1, 2, 3}
    assert np.isnan(cleaned(np.full((5, 6), np.nan, np.float32))).all()
