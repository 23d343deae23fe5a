"""Spectra over HTTP in pages and pieces of bounded size."""

from __future__ import annotations

import io
import json
import tracemalloc
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from specimap_core.cloud import Cloud
from specimap_service import array_responses
from specimap_service.array_responses import ARROW, BATCH, JSON, NPY
from specimap_service.clouds import spectra, spectra_routes
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.result_scene import put_result
from tests.support.service_scene import serving
from tests.support.spectra_scene import BANDS, COLS, ROWS, large_cloud, read, table_of

LAST = ("spectra", "fields")


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[httpx.Client, Cloud]]:
    with large_cloud(tmp_path_factory.mktemp("spectra")) as served:
        yield served


@pytest.fixture(scope="module")
def reader(served: tuple[httpx.Client, Cloud]) -> httpx.Client:
    return served[0]


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> Iterator[httpx.Client]:
    """A client of a cloud with as many bands as usual."""
    folder = tmp_path_factory.mktemp("wide")
    with serving(folder / "service") as running:
        cube = FakeCube(counts(ROWS, COLS, 290))
        result = put_result(running, folder / "result", cube=cube, points=scene(ROWS, COLS, 0.9))
        client = running.client(("read",), rate_per_minute=1_000_000)
        client.base_url = httpx.URL(f"{running.url}/v1/clouds/{result.cloud_id}/")
        yield client


@pytest.fixture(scope="module")
def cloud(served: tuple[httpx.Client, Cloud]) -> Cloud:
    return served[1]


@pytest.mark.parametrize("accept", [JSON, NPY, ARROW])
def test_pages_add_up(reader: httpx.Client, cloud: Cloud, accept: str) -> None:
    select = {"box": {"low": [-1e3] * 3, "high": [1e3] * 3}}
    parts, offset, pages = [], 0, 0
    while True:
        answer = read(reader, accept, select, limit=7000, offset=offset)
        if accept == JSON:
            parts.append(np.array(answer.json()["spectra"], np.float32))
            assert answer.json()["next_offset"] == (int(answer.headers.get("x-specimap-next-offset", 0)) or None)
        elif accept == NPY:
            parts.append(np.load(io.BytesIO(answer.content)))
        else:
            parts.append(table_of(answer)[1]["spectrum"])
        pages += 1
        if "x-specimap-next-offset" not in answer.headers:
            break
        offset = int(answer.headers["x-specimap-next-offset"])
    assert pages == -(-cloud.n_points // 7000)
    np.testing.assert_allclose(np.concatenate(parts), cloud.spectra(slice(None)), rtol=1e-6)


def test_pages_have_their_limits(reader: httpx.Client, cloud: Cloud) -> None:
    everything = {"box": {"low": [-1e3] * 3, "high": [1e3] * 3}}
    assert len(read(reader, JSON, everything).json()["indices"]) == 2000
    assert len(read(reader, JSON, everything, limit=100_000).json()["indices"]) == 10_000
    assert len(np.load(io.BytesIO(read(reader, NPY, everything).content))) == 10_000
    table, _ = table_of(read(reader, ARROW, everything, limit=100_000))
    assert table.num_rows == cloud.n_points
    assert max(len(batch) for batch in table.to_batches()) == BATCH
    for accept in (JSON, NPY, ARROW):
        beyond = read(reader, accept, everything, offset=10**6)
        assert beyond.headers["x-specimap-total"] == str(cloud.n_points)
        assert "x-specimap-next-offset" not in beyond.headers
    assert np.load(io.BytesIO(read(reader, NPY, everything, offset=10**6).content)).shape == (0, BANDS)
    assert table_of(read(reader, ARROW, everything, offset=10**6))[0].num_rows == 0


@pytest.mark.parametrize("accept", [JSON, NPY, ARROW])
def test_a_page_has_fewer_points_where_they_have_many_bands(
    reader: httpx.Client, cloud: Cloud, accept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("MOST_VALUES", "MOST_JSON_VALUES"):
        monkeypatch.setattr(spectra_routes, name, 1000)
    everything = {"box": {"low": [-1e3] * 3, "high": [1e3] * 3}}
    for bands, points in ((None, 200), ({"indices": [4, 0]}, 500)):
        answer = read(reader, accept, everything, limit=100_000, **({} if bands is None else {"bands": bands}))
        assert answer.headers["x-specimap-next-offset"] == str(points)
        if accept == NPY:
            assert np.load(io.BytesIO(answer.content)).shape == (points, 1000 // points)
        else:
            found = answer.json()["indices"] if accept == JSON else table_of(answer)[1]["index"]
            np.testing.assert_array_equal(found, np.arange(points))


@pytest.mark.parametrize("accept", [JSON, NPY, ARROW])
def test_points_in_any_order_come_in_pieces_of_bounded_size(
    reader: httpx.Client, cloud: Cloud, accept: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(array_responses, "BATCH_VALUES", 2000)
    monkeypatch.setattr(array_responses, "JSON_BATCH_VALUES", 2000)
    monkeypatch.setattr(spectra, "ROUND_VALUES", 5001)
    read_together: list[int] = []
    stored_spectra = Cloud.stored_spectra

    def counted(self: Cloud, indices: Any, bands: Any = None) -> NDArray[np.uint16]:
        read_together.append(len(indices))
        return stored_spectra(self, indices, bands)

    monkeypatch.setattr(Cloud, "stored_spectra", counted)
    points = np.random.default_rng(0).integers(0, cloud.n_points, 3210)
    answer = read(reader, accept, {"indices": points.tolist()}, limit=100_000, fields=["flags", "xyz"])
    assert max(read_together) <= 5001 // BANDS
    # Whole rounds, of which the batches are cut: not each batch for itself.
    assert len(read_together) <= 1 + 3210 // (2 * (2000 // BANDS))
    wanted = stored_spectra(cloud, points)
    if accept == JSON:
        body = answer.json()
        found = np.array(body["spectra"], np.float32)
        np.testing.assert_array_equal(body["fields"]["flags"], cloud.flags[points])
        assert list(body) == ["total", "offset", "next_offset", "quantity", "bands", "wavelength_nm", "indices", *LAST]
    elif accept == NPY:
        found = np.load(io.BytesIO(answer.content))
    else:
        table, columns = table_of(answer)
        assert max(len(batch) for batch in table.to_batches()) == 2000 // BANDS
        found = columns["spectrum"]
        np.testing.assert_array_equal(columns["xyz"], cloud.xyz[points])
    np.testing.assert_allclose(found, cloud.decode(wanted), rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("accept", [JSON, NPY, ARROW])
def test_a_long_answer_takes_little_memory(wide: httpx.Client, accept: str) -> None:
    points = np.random.default_rng(0).integers(0, 20_000, 100_000).tolist()
    body = json.dumps({"select": {"indices": points}, "limit": 100_000})
    headers = {"Accept": accept, "Content-Type": "application/json", "Accept-Encoding": "identity"}
    wide.post("spectra", content=body.replace("100000", "1"), headers=headers)  # opens the cloud
    pool, received = pa.default_memory_pool(), 0
    # The server runs in this process, which sees what it allocates.
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    try:
        with wide.stream("POST", "spectra", content=body, headers=headers) as answer:
            assert answer.status_code == 200
            for piece in answer.iter_raw():
                received += len(piece)
            peak = tracemalloc.get_traced_memory()[1] - before + (pool.max_memory() if accept == ARROW else 0)
    finally:
        tracemalloc.stop()
    assert received > (20e6 if accept == JSON else 100e6)
    assert peak < 50e6
