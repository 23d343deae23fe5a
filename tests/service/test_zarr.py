"""Clouds over HTTP as Zarr groups: what clients read, hostile keys, pages of other origins, labels."""

from __future__ import annotations

import http.client
import json
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
import tensorstore
import xarray
import zarr
from obstore.store import HTTPStore
from zarr.storage import ObjectStore

from specimap_core.cloud import ARRAYS
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import Result, put_label, put_result
from tests.support.service_scene import Running, serving

SHARD = "spectra/c/0/0"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with serving(tmp_path_factory.mktemp("zarr"), cors_origins=["https://viewer.example"]) as running:
        yield running


@pytest.fixture(scope="module")
def result(service: Running, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return put_result(service, tmp_path_factory.mktemp("result") / "local")


@pytest.fixture(scope="module")
def reader(service: Running, result: Result) -> httpx.Client:
    client = service.client(("read",))
    client.base_url = httpx.URL(f"{service.url}/v1/clouds/{result.cloud_id}/zarr/")
    return client


def zarr_store(service: Running, result: Result, key: str) -> ObjectStore[HTTPStore]:
    options = {"allow_http": True, "default_headers": {"Authorization": f"Bearer {key}"}}
    url = f"{service.url}/v1/clouds/{result.cloud_id}/zarr"
    return ObjectStore(HTTPStore(url, client_options=options), read_only=True)  # type: ignore[arg-type]


def array_of(group: zarr.Group, name: str) -> np.ndarray:
    array = group[name]
    assert isinstance(array, zarr.Array)
    return np.asarray(array[...])


# ---- clients ------------------------------------------------------------------------------------------


def test_zarr_python_reads_every_array(service: Running, result: Result) -> None:
    group = zarr.open_group(zarr_store(service, result, service.key(("read",))), mode="r")
    assert sorted(group.array_keys()) == sorted(ARRAYS)
    for name in ARRAYS:
        mine = result.cloud.array(name)
        np.testing.assert_array_equal(array_of(group, name), mine.read(0, mine.shape[0]), err_msg=name)
    assert group.attrs["frame"] == "marker"


def test_xarray_reads_reflectance(service: Running, result: Result) -> None:
    with xarray.open_zarr(zarr_store(service, result, service.key(("read",))), chunks=None) as data:
        assert data.spectra.dims == ("point", "band")
        np.testing.assert_allclose(data.spectra.values, result.cloud.spectra(slice(None)), rtol=1e-6)
        np.testing.assert_array_equal(data.xyz.values, result.cloud.xyz)


def test_tensorstore_reads_parts(service: Running, result: Result) -> None:
    store = {
        "driver": "http",
        "base_url": f"{service.url}/v1/clouds/{result.cloud_id}/zarr/",
        "path": "spectra/",
        "headers": [f"Authorization: Bearer {service.key(('read',))}"],
    }
    array = tensorstore.open({"driver": "zarr3", "kvstore": store}, open=True).result()
    stored = result.cloud.stored_spectra(slice(None))
    np.testing.assert_array_equal(array[300:900].read().result(), stored[300:900])
    np.testing.assert_array_equal(array[[7, 2900, 511], 3].read().result(), stored[[7, 2900, 511], 3])


def test_files_are_the_stored_ones(reader: httpx.Client, result: Result) -> None:
    files = [path for path in (result.local / "cloud.zarr").rglob("*") if path.is_file()]
    assert len(files) == 1 + 2 * len(ARRAYS)
    for path in files:
        key = path.relative_to(result.local / "cloud.zarr").as_posix()
        if key == "zarr.json":
            continue
        answer = reader.get(key)
        assert (answer.status_code, answer.content) == (200, path.read_bytes()), key
        wanted = "application/json" if key.endswith("zarr.json") else "application/octet-stream"
        assert answer.headers["content-type"] == wanted
    own = json.loads((result.local / "cloud.zarr" / "zarr.json").read_bytes())
    served = reader.get("zarr.json").json()
    members = served.pop("consolidated_metadata")["metadata"]
    assert served == own
    assert members["xyz"] == json.loads((result.local / "cloud.zarr" / "xyz" / "zarr.json").read_bytes())


# ---- who may, and what there is not -----------------------------------------------------------------------


def test_the_scope_read_is_needed(service: Running, result: Result) -> None:
    path = f"/v1/clouds/{result.cloud_id}/zarr/zarr.json"
    refused = service.client(("upload", "label")).get(path)
    assert (refused.status_code, refused.json()["details"]) == (403, {"scope": "read"})
    assert httpx.get(service.url + path, trust_env=False, verify=NO_TLS).status_code == 401


HOSTILE = (
    "../report.json",
    "spectra/../../report.json",
    "%2e%2e/report.json",
    "spectra/%2e%2e/%2e%2e/report.json",
    "spectra%2Fzarr.json",
    "spectra%2fc%2f0%2f0",
    "..%5creport.json",
    "..\\report.json",
    "/etc/passwd",
    "/spectra/zarr.json",
    "//spectra/zarr.json",
    "./zarr.json",
    "spectra//zarr.json",
    "spectra/./zarr.json",
    "spectra",
    "spectra/",
    "spectra/c",
    "",
    "zarr.json/",
    "zarr.json%00",
    # Longer than a name and than a key may be.
    f"spectra/{'a' * 256}",
    f"spectra/c{'/0' * 600}",
    "spectra/zarr.json%00.png",
    "labels",
    "labels/",
    "labels/zarr.json",
    "labels/../xyz/zarr.json",
    "labels/tissue/zarr.json",
    ".zgroup",
    "spectra/.zarray",
    "report.json",
    "mesh.ply",
    "c/0",
    "spectra/c/0/0/0",
    "spectra/c/4/0",
    "spectra/zarr.json;x",
    "%zz",
    "a" * 5000,
    "spectra/c/" + "0/" * 200,
)


@pytest.mark.parametrize("key", HOSTILE)
def test_other_keys_are_not_found(service: Running, result: Result, key: str) -> None:
    host, port = service.url.removeprefix("http://").split(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=30)
    try:
        connection.request(
            "GET", f"/v1/clouds/{result.cloud_id}/zarr/{key}", headers={"Authorization": f"Bearer {service.key()}"}
        )
        answer = connection.getresponse()
        problem = json.loads(answer.read())
    finally:
        connection.close()
    assert (answer.status, problem["code"]) == (404, "not_found")
    assert result.prefix not in json.dumps(problem)


def test_pages_of_allowed_origins_may_read_ranges(service: Running, result: Result) -> None:
    path, origin = f"/v1/clouds/{result.cloud_id}/zarr/{SHARD}", {"Origin": "https://viewer.example"}
    asked = {"Access-Control-Request-Method": "GET", "Access-Control-Request-Headers": "authorization, range"}
    preflight = httpx.options(service.url + path, headers=origin | asked, trust_env=False, verify=NO_TLS)
    assert preflight.status_code == 200
    assert {"authorization", "range"} <= set(preflight.headers["access-control-allow-headers"].lower().split(", "))
    answer = service.client(("read",)).get(path, headers=origin | {"Range": "bytes=-20"})
    assert answer.status_code == 206
    assert answer.headers["access-control-allow-origin"] == "https://viewer.example"
    exposed = answer.headers["access-control-expose-headers"].lower()
    assert all(name in exposed for name in ("content-range", "etag", "accept-ranges", "content-length"))


# ---- labels ---------------------------------------------------------------------------------------------


def test_labels_appear_in_their_current_version(service: Running, tmp_path_factory: pytest.TempPathFactory) -> None:
    result = put_result(service, tmp_path_factory.mktemp("labelled") / "local")
    key = service.key(("read",))
    client = service.client(("read",))
    points = result.cloud.n_points
    before = client.get(f"/v1/clouds/{result.cloud_id}/zarr/zarr.json").headers["etag"]
    first, second = (np.random.default_rng(i).integers(0, 4, points).astype(np.uint8) for i in (1, 2))
    probability = np.random.default_rng(3).random((points, 3)).astype(np.float32)
    put_label(service, result, "tissue", first)
    put_label(service, result, "tumour", probability)
    group = zarr.open_group(zarr_store(service, result, key), mode="r")
    np.testing.assert_array_equal(array_of(group, "labels/tissue"), first)
    put_label(service, result, "tissue", second)
    group = zarr.open_group(zarr_store(service, result, key), mode="r")
    labels = group["labels"]
    assert isinstance(labels, zarr.Group)
    assert sorted(labels.array_keys()) == ["tissue", "tumour"]
    np.testing.assert_array_equal(array_of(labels, "tissue"), second)
    np.testing.assert_array_equal(array_of(group, "labels/tumour"), probability)
    with xarray.open_zarr(zarr_store(service, result, key), group="labels", chunks=None) as data:
        np.testing.assert_array_equal(data.tissue.values, second)
        assert data.tumour.dims == ("point", "class")
    answer = client.get(f"/v1/clouds/{result.cloud_id}/zarr/labels/tissue/c/0", headers={"Range": "bytes=0-9"})
    assert (answer.status_code, answer.headers["cache-control"]) == (206, "private, no-cache")
    assert client.get(f"/v1/clouds/{result.cloud_id}/zarr/zarr.json").headers["etag"] != before
    assert client.get(f"/v1/clouds/{result.cloud_id}/zarr/labels/bone/zarr.json").status_code == 404
