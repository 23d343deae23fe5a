"""Spectra over HTTP: one point, every way to select, what is refused."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.cloud import Cloud
from specimap_service.array_responses import ARROW, JSON, NPY
from tests.support.spectra_scene import BANDS, COLS, ROWS, large_cloud, read, table_of


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, Cloud]]:
    with large_cloud(tmp_path_factory.mktemp("spectra")) as served:
        yield served


@pytest.fixture(scope="module")
def reader(served: tuple[httpx.Client, Cloud]) -> httpx.Client:
    return served[0]


@pytest.fixture(scope="module")
def cloud(served: tuple[httpx.Client, Cloud]) -> Cloud:
    return served[1]


# ---- one point --------------------------------------------------------------------------------------------


def test_a_point_is_what_the_cloud_holds(reader: httpx.Client, cloud: Cloud) -> None:
    for index in (0, 50, 257, cloud.n_points - 1):
        point = reader.get(f"points/{index}").json()
        for name in ("xyz", "normal", "rgb", "hsi_pixel", "sigma_mm", "flags"):
            np.testing.assert_allclose(point[name], getattr(cloud, name)[index], rtol=1e-6, err_msg=name)
        np.testing.assert_allclose(point["spectrum"], cloud.spectra([index])[0], rtol=1e-6)
        np.testing.assert_allclose(point["wavelength_nm"], cloud.wavelengths_nm)
        assert (point["index"], point["quantity"], point["bands"]) == (index, "reflectance", list(range(BANDS)))
        assert point["labels"] == {}
    flagged = int(np.flatnonzero(cloud.flags == 5)[0])
    assert reader.get(f"points/{flagged}").json()["flag_names"] == ["specimen", "grazing"]


def test_bands_of_a_point(reader: httpx.Client, cloud: Cloud) -> None:
    point = reader.get("points/7", params={"bands": "4,0-2"}).json()
    assert point["bands"] == [4, 0, 1, 2]
    np.testing.assert_allclose(point["spectrum"], cloud.spectra([7], [4, 0, 1, 2])[0], rtol=1e-6)
    np.testing.assert_allclose(point["wavelength_nm"], cloud.wavelengths_nm[[4, 0, 1, 2]])
    for wrong in ("2,2", "0-3,1", "", "a", "1-", "5", "3-1", "0,99999", "1,,2", ",".join(["0-65535"] * 9)):
        answer = reader.get("points/7", params={"bands": wrong})
        assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid"), wrong


@pytest.mark.parametrize(
    ("index", "status"), [("22400", 404), ("4294967295", 404), ("4294967296", 422), ("-1", 422), ("x", 422)]
)
def test_points_that_are_not(reader: httpx.Client, index: str, status: int) -> None:
    answer = reader.get(f"points/{index}")
    assert answer.status_code == status
    assert answer.json()["advice"]


# ---- selections -------------------------------------------------------------------------------------------


def chosen(cloud: Cloud) -> list[tuple[dict[str, Any], NDArray[np.intp]]]:
    """Selections and the points they mean, by brute force."""
    xyz, pixels = cloud.xyz.astype(float), cloud.hsi_pixel.astype(int)
    centre = np.array([6.0, -5.0, 0.5])
    distance = np.linalg.norm(xyz - centre, axis=1)
    low, high = np.array([2, -9, -1.5]), np.array([7, -4, 1])
    taken = {tuple(pixel) for pixel in pixels.tolist()}
    empty = next([r, c] for r in range(ROWS) for c in range(COLS) if (r, c) not in taken)
    asked = [pixels[900].tolist(), empty, pixels[3].tolist(), [60000, 2]]
    square = (pixels >= [10, 20]).all(1) & (pixels <= [60, 90]).all(1)
    return [
        ({"indices": [9, 5000, 9, 0]}, np.array([9, 5000, 9, 0])),
        ({"pixels": asked}, np.array([900, 3])),
        ({"polygon": [[10, 20], [10, 90], [60, 90], [60, 20]]}, np.flatnonzero(square)),
        ({"nearest": {"xyz": centre.tolist(), "k": 700}}, np.argsort(distance, kind="stable")[:700]),
        ({"box": {"low": low.tolist(), "high": high.tolist()}}, np.flatnonzero(((xyz >= low) & (xyz <= high)).all(1))),
        ({"radius": {"centre": centre.tolist(), "radius_mm": 2.5}}, np.flatnonzero(distance <= 2.5)),
    ]


def test_all_selections_in_all_forms(reader: httpx.Client, cloud: Cloud) -> None:
    for select, points in chosen(cloud):
        fields = ["hsi_pixel", "flags"]
        spectra = cloud.spectra(points)
        answer = read(reader, JSON, select, fields=fields, limit=10_000)
        body = answer.json()
        assert (body["total"], body["next_offset"], body["offset"]) == (len(points), None, 0)
        assert answer.headers["x-specimap-total"] == str(len(points))
        assert "x-specimap-next-offset" not in answer.headers
        np.testing.assert_array_equal(body["indices"], points)
        np.testing.assert_allclose(body["spectra"], spectra, rtol=1e-6)
        np.testing.assert_array_equal(body["fields"]["hsi_pixel"], cloud.hsi_pixel[points])
        np.testing.assert_array_equal(body["fields"]["flags"], cloud.flags[points])
        np.testing.assert_array_equal(np.load(io.BytesIO(read(reader, NPY, select).content)), spectra)
        table, columns = table_of(read(reader, ARROW, select, fields=fields))
        assert table.column_names == ["index", "hsi_pixel", "flags", "spectrum"]
        np.testing.assert_array_equal(columns["index"], points)
        np.testing.assert_array_equal(columns["spectrum"], spectra)
        np.testing.assert_array_equal(columns["hsi_pixel"], cloud.hsi_pixel[points])
        assert json.loads(table.schema.metadata[b"total"]) == len(points)
        np.testing.assert_allclose(json.loads(table.schema.metadata[b"wavelength_nm"]), cloud.wavelengths_nm)
        assert table.schema.metadata[b"quantity"] == b"reflectance"


def test_fields_and_distances(reader: httpx.Client, cloud: Cloud) -> None:
    centre = [6.0, -5.0, 0.5]
    fields = ["xyz", "normal", "rgb", "hsi_pixel", "sigma_mm", "flags", "distance_mm"]
    for select in ({"nearest": {"xyz": centre, "k": 30}}, {"radius": {"centre": centre, "radius_mm": 1}}):
        _, columns = table_of(read(reader, ARROW, select, fields=fields))
        body = read(reader, JSON, select, fields=fields).json()
        for name in fields[:-1]:
            wanted = getattr(cloud, name)[columns["index"]]
            np.testing.assert_array_equal(columns[name], wanted)
            assert columns[name].dtype == wanted.dtype
            np.testing.assert_allclose(body["fields"][name], wanted, rtol=1e-6)
        wanted = np.linalg.norm(cloud.xyz[columns["index"]] - centre, axis=1)
        np.testing.assert_allclose(columns["distance_mm"], wanted, rtol=1e-5)
        np.testing.assert_allclose(body["fields"]["distance_mm"], wanted, rtol=1e-5)
    _, columns = table_of(read(reader, ARROW, {"nearest": {"xyz": centre, "k": 30}}, fields=["distance_mm"]))
    assert (np.diff(columns["distance_mm"]) >= 0).all()


def test_band_ranges(reader: httpx.Client, cloud: Cloud) -> None:
    select = {"indices": [3, 4]}
    for bands, numbers in (({"nm": [550, 850]}, [1, 2, 3]), ({"nm": [400, 400]}, [0]), ({"indices": [4, 0]}, [4, 0])):
        if "nm" in bands:
            low, high = bands["nm"]
            numbers = np.flatnonzero((cloud.wavelengths_nm >= low) & (cloud.wavelengths_nm <= high)).tolist()
        body = read(reader, JSON, select, bands=bands).json()
        assert body["bands"] == numbers
        np.testing.assert_allclose(body["spectra"], cloud.spectra([3, 4], numbers), rtol=1e-6)
        stored = np.load(io.BytesIO(read(reader, NPY, select, bands=bands).content))
        np.testing.assert_array_equal(stored, cloud.spectra([3, 4], numbers))


def test_an_outline_that_crosses_more_rows_than_any_is_refused(reader: httpx.Client) -> None:
    zigzag = [[0 if k % 2 else 1e6, k / 100] for k in range(10_000)]
    answer = reader.post("spectra", json={"select": {"polygon": zigzag}})
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert answer.json()["details"]["limit"] == 1_000_000
    # As many corners around a few rows are an outline like others.
    turns = np.linspace(0, 2 * np.pi, 10_000, endpoint=False)
    circle = np.stack([80 + 50 * np.sin(turns), 70 + 50 * np.cos(turns)], 1).tolist()
    assert reader.post("spectra", json={"select": {"polygon": circle}}).json()["total"] > 5000


def test_nothing_found_is_an_empty_answer(reader: httpx.Client) -> None:
    for select in (
        {"radius": {"centre": [900, 0, 0], "radius_mm": 1}},
        {"pixels": [[65535, 65535]]},
        {"polygon": [[900, 900], [900, 910], [910, 900]]},
    ):
        body = read(reader, JSON, select, fields=["xyz"]).json()
        assert (body["total"], body["indices"], body["spectra"], body["fields"]) == (0, [], [], {"xyz": []})
        assert table_of(read(reader, ARROW, select, fields=["xyz"]))[0].num_rows == 0


# ---- refusals ---------------------------------------------------------------------------------------------

ZERO = "[0, 0, 0]"


BAD = (
    '{"select": {}}',
    '{"select": {"indices": [1], "pixels": [[1, 1]]}}',
    '{"select": {"indices": []}}',
    "{}",
    "[]",
    "{",
    '{"select": {"indices": [99999]}}',
    '{"select": {"indices": [-1]}}',
    '{"select": {"indices": [1.5]}}',
    '{"select": {"indices": [18446744073709551616]}}',
    '{"select": {"pixels": []}}',
    '{"select": {"pixels": [[1]]}}',
    '{"select": {"pixels": [[-1, 0]]}}',
    '{"select": {"polygon": []}}',
    '{"select": {"polygon": [[0, 0], [1, 1]]}}',
    '{"select": {"polygon": [[0, 0], [1, NaN], [2, 0]]}}',
    '{"select": {"polygon": [[0, 0], [1, 1e300], [2, 0]]}}',
    f'{{"select": {{"nearest": {{"xyz": {ZERO}, "k": 0}}}}}}',
    '{"select": {"nearest": {"xyz": [0, 0, NaN]}}}',
    '{"select": {"nearest": {"xyz": [0, Infinity, 0]}}}',
    '{"select": {"nearest": {"xyz": [0, 0]}}}',
    f'{{"select": {{"nearest": {{"xyz": {ZERO}, "k": 100001}}}}}}',
    f'{{"select": {{"box": {{"low": [1, 0, 0], "high": {ZERO}}}}}}}',
    f'{{"select": {{"radius": {{"centre": {ZERO}, "radius_mm": -1}}}}}}',
    f'{{"select": {{"radius": {{"centre": {ZERO}, "radius_mm": NaN}}}}}}',
    '{"select": {"indices": [1]}, "bands": {}}',
    '{"select": {"indices": [1]}, "bands": {"indices": [5]}}',
    '{"select": {"indices": [1]}, "bands": {"indices": []}}',
    '{"select": {"indices": [1]}, "bands": {"indices": [3, 0, 3]}}',
    '{"select": {"indices": [1]}, "bands": {"nm": [1, 2]}}',
    '{"select": {"indices": [1]}, "bands": {"nm": [900, 400]}}',
    '{"select": {"indices": [1]}, "fields": ["spectra"]}',
    '{"select": {"indices": [1]}, "bands": {"nm": [400, NaN]}}',
    '{"select": {"indices": [1]}, "limit": 0}',
    '{"select": {"indices": [1]}, "limit": 100001}',
    '{"select": {"indices": [1]}, "offset": -1}',
    '{"select": {"indices": [1]}, "fields": ["distance_mm"]}',
    '{"select": {"indices": [1]}, "more": 1}',
)


@pytest.mark.parametrize("body", BAD)
def test_bad_requests_are_told_what_to_do(reader: httpx.Client, body: str) -> None:
    answer = reader.post("spectra", content=body, headers={"Content-Type": "application/json"})
    problem = answer.json()
    assert (answer.status_code, problem["code"]) == (422, "request_invalid"), problem
    assert problem["advice"]
    assert problem["detail"]
