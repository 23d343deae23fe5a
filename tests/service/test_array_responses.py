"""Spectra over HTTP: the forms of an answer, labels, unknown values, many clients, buckets."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import numpy as np
import pytest
import zarr
from numpy.typing import NDArray
from obstore.store import HTTPStore
from zarr.storage import ObjectStore

from specimap_core.cloud import Cloud
from specimap_service.array_responses import ARROW, JSON, NPY
from tests.support.cloud_scene import FakeCube, counts
from tests.support.object_store import object_store
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_label, put_result
from tests.support.service_scene import Running, serving
from tests.support.spectra_scene import BANDS, large_cloud, table_of


class UnknownWavelengths(FakeCube):
    """A cube whose header lacks the wavelengths."""

    @property
    def wavelengths_nm(self) -> NDArray[np.float64]:
        return np.full(self.bands, np.nan)


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


# ---- forms ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("accept", "media"),
    [
        (None, JSON),
        ("*/*", JSON),
        ("application/*", JSON),
        (f"{JSON};q=0.5, {NPY}", NPY),
        (f"{ARROW}, */*;q=0.1", ARROW),
        (f"{JSON};q=0, */*", ARROW),
        ("text/html, */*;q=0.8", JSON),
        ("APPLICATION/X-NPY", NPY),
        ("text/html", None),
        (f"{JSON};q=0", None),
        ("image/*;q=1, text/*", None),
        (f"{NPY};q=nonsense", None),
    ],
)
def test_the_form_that_is_accepted(reader: httpx.Client, accept: str | None, media: str | None) -> None:
    body = {"select": {"indices": [0]}}
    for request in (reader.build_request("POST", "spectra", json=body), reader.build_request("GET", "bands/0")):
        request.headers.pop("Accept")
        if accept is not None:
            request.headers["Accept"] = accept
        answer = reader.send(request)
        if media is None:
            assert (answer.status_code, answer.json()["code"]) == (406, "not_acceptable")
            assert answer.json()["details"]["offered"] == [JSON, ARROW, NPY]
        else:
            assert (answer.status_code, answer.headers["content-type"]) == (200, media)


def test_a_band_of_all_points(reader: httpx.Client, cloud: Cloud) -> None:
    values = cloud.band(3)
    for accept in (JSON, NPY, ARROW):
        answer = reader.get("bands/3", headers={"Accept": accept})
        if accept == JSON:
            body = answer.json()
            np.testing.assert_allclose(body["values"], values, rtol=1e-6)
            assert (body["band"], body["quantity"]) == (3, "reflectance")
            assert body["wavelength_nm"] == pytest.approx(float(cloud.wavelengths_nm[3]))
        elif accept == NPY:
            np.testing.assert_array_equal(np.load(io.BytesIO(answer.content)), values)
        else:
            np.testing.assert_array_equal(table_of(answer)[1]["value"], values)
        etag = answer.headers["etag"]
        again = reader.get("bands/3", headers={"Accept": accept, "If-None-Match": etag})
        assert (again.status_code, again.content) == (304, b"")
        other = NPY if accept == JSON else JSON
        assert reader.get("bands/3", headers={"Accept": other, "If-None-Match": etag}).status_code == 200
        assert reader.get("bands/2", headers={"Accept": accept, "If-None-Match": etag}).status_code == 200
    assert reader.get(f"bands/{BANDS}").status_code == 404
    assert reader.get("bands/-1").status_code == 422


def test_a_point_has_its_labels(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    points = result.cloud.n_points
    classes = np.random.default_rng(1).integers(0, 500, points).astype(np.uint16)
    shares = np.random.default_rng(2).random((points, 2)).astype(np.float32)
    shares[:100] = np.nan
    put_label(service, result, "tissue", classes)
    put_label(service, result, "tumour", shares)
    put_label(service, result, "margin", shares[:, 0])
    client = service.client(("read",))
    for index in (0, 99, 100, points - 1):
        labels = client.get(f"/v1/clouds/{result.cloud_id}/points/{index}").json()["labels"]
        assert labels["tissue"] == classes[index]
        if index < 100:
            assert (labels["tumour"], labels["margin"]) == ([None, None], None)
        else:
            np.testing.assert_allclose(labels["tumour"], shares[index], rtol=1e-6)
            assert labels["margin"] == pytest.approx(shares[index, 0])


def test_what_is_not_known_is_null(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result", cube=UnknownWavelengths(counts()))
    client, here = service.client(("read",)), f"/v1/clouds/{result.cloud_id}"
    request = {"select": {"indices": [1]}}
    answers = [
        client.get(here),
        client.get(f"{here}/points/1"),
        client.post(f"{here}/spectra", json=request),
        client.get(f"{here}/bands/0"),
    ]
    for answer in answers:
        assert answer.status_code == 200
        assert "NaN" not in answer.text
        assert answer.json()["wavelength_nm"] in (None, [None] * 7)
    arrow = client.post(f"{here}/spectra", json=request, headers={"Accept": ARROW})
    assert json.loads(table_of(arrow)[0].schema.metadata[b"wavelength_nm"]) == [None] * 7
    refused = client.post(f"{here}/spectra", json=request | {"bands": {"nm": [400, 500]}})
    assert (refused.status_code, refused.json()["code"]) == (422, "request_invalid")
    assert "unknown wavelength" in refused.json()["detail"]


# ---- many clients, buckets --------------------------------------------------------------------------------


@pytest.mark.slow
def test_many_clients_get_their_own_spectra(reader: httpx.Client, cloud: Cloud) -> None:
    truth = cloud.spectra(slice(None))

    def ask(seed: int) -> None:
        rng = np.random.default_rng(seed)
        with httpx.Client(
            base_url=reader.base_url, headers=reader.headers, timeout=60, trust_env=False, verify=NO_TLS
        ) as own:
            for _ in range(6):
                points = rng.integers(0, cloud.n_points, 3)
                body = {"select": {"indices": points.tolist()}}
                answer = own.post("spectra", json=body, headers={"Accept": NPY})
                np.testing.assert_array_equal(np.load(io.BytesIO(answer.content)), truth[points])
                spectrum = own.get(f"points/{points[0]}").json()["spectrum"]
                np.testing.assert_allclose(spectrum, truth[points[0]], rtol=1e-6)

    with ThreadPoolExecutor(64) as pool:
        list(pool.map(ask, range(64)))


@pytest.mark.slow
def test_a_bucket_serves_alike(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with (
        object_store("clouds") as endpoint,
        serving(tmp_path / "service", storage="s3://clouds/here", s3_endpoint=endpoint) as running,
    ):
        result = put_result(running, tmp_path / "result")
        cloud, here = result.cloud, f"/v1/clouds/{result.cloud_id}"
        labels = np.arange(cloud.n_points).astype(np.uint16)
        put_label(running, result, "tissue", labels)
        client = running.client(("read",))
        point = client.get(f"{here}/points/2000").json()
        np.testing.assert_allclose(point["spectrum"], cloud.spectra([2000])[0], rtol=1e-6)
        assert point["labels"] == {"tissue": 2000}
        for select, points in (
            ({"indices": [2900, 1]}, [2900, 1]),
            ({"radius": {"centre": [2, -2, 0], "radius_mm": 1}}, cloud.in_radius([2, -2, 0], 1)),
        ):
            answer = client.post(f"{here}/spectra", json={"select": select}, headers={"Accept": NPY})
            np.testing.assert_array_equal(np.load(io.BytesIO(answer.content)), cloud.spectra(points))
        answer = client.get(f"{here}/bands/6", headers={"Accept": NPY})
        np.testing.assert_array_equal(np.load(io.BytesIO(answer.content)), cloud.band(6))
        shard = (result.local / "cloud.zarr" / "spectra" / "c" / "0" / "0").read_bytes()
        whole = client.get(f"{here}/zarr/spectra/c/0/0")
        assert whole.content == shard
        part = client.get(f"{here}/zarr/spectra/c/0/0", headers={"Range": "bytes=-500"})
        assert (part.status_code, part.content) == (206, shard[-500:])
        known = {"If-None-Match": whole.headers["etag"]}
        assert client.get(f"{here}/zarr/spectra/c/0/0", headers=known).status_code == 304
        assert client.get(f"{here}/zarr/spectra/c/8/0").status_code == 404
        large = np.random.default_rng(0).bytes(20_000_000)
        running.storage.put(f"{result.prefix}/cloud.zarr/rgb/c/5/0", large)
        assert client.get(f"{here}/zarr/rgb/c/5/0").content == large
        options = {"allow_http": True, "default_headers": {"Authorization": client.headers["Authorization"]}}
        http = HTTPStore(f"{running.url}{here}/zarr", client_options=options)  # type: ignore[arg-type]
        group = zarr.open_group(ObjectStore(http, read_only=True), mode="r")
        spectra, tissue = group["spectra"], group["labels/tissue"]
        assert isinstance(spectra, zarr.Array)
        assert isinstance(tissue, zarr.Array)
        np.testing.assert_array_equal(np.asarray(spectra[...]), cloud.stored_spectra(slice(None)))
        np.testing.assert_array_equal(np.asarray(tissue[...]), labels)
        running.storage.delete(f"{result.prefix}/cloud.zarr/spectra")
        damaged = client.get(f"{here}/bands/5")
        assert (damaged.status_code, damaged.json()["code"]) == (500, "cloud_damaged")
