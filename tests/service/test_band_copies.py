"""Copies from which single bands are read: equal to the cloud, bounded, gone with it, and never needed."""

from __future__ import annotations

import io
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from specimap_core.cloud import Cloud
from specimap_service.array_responses import NPY
from specimap_service.clouds import band_copies
from tests.support.cloud_scene import FakeCube, counts, scene
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving

ROWS, COLS, BANDS = 40, 50, 7
SIZE = 2 * BANDS


@pytest.fixture(autouse=True)
def any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(band_copies, "LEAST_BYTES", 1)
    monkeypatch.setattr(band_copies, "SWEEP_SECONDS", 0.1)


@pytest.fixture
def running(tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service") as found:
        yield found


def result_of(running: Running, folder: Path) -> Result:
    return put_result(running, folder, cube=FakeCube(counts(ROWS, COLS, BANDS)), points=scene(ROWS, COLS, 0.9))


def read(client: httpx.Client, result: Result, band: int) -> np.ndarray:
    answer = client.get(f"/v1/clouds/{result.cloud_id}/bands/{band}", headers={"Accept": NPY})
    assert answer.status_code == 200, answer.text
    values: np.ndarray = np.load(io.BytesIO(answer.content))
    return values


def copies(running: Running) -> list[Path]:
    return sorted((running.settings.scratch / band_copies.FOLDER).glob("*"))


def wait_for(met: Callable[[], bool]) -> None:
    end = time.monotonic() + 30
    while not met():
        assert time.monotonic() < end
        time.sleep(0.02)


def copied(running: Running, client: httpx.Client, result: Result) -> Path:
    """The finished copy of a result."""
    read(client, result, 0)
    path = running.settings.scratch / band_copies.FOLDER / f"{result.cloud_id}.u2"
    wait_for(path.is_file)
    return path


def test_bands_from_a_copy_are_those_of_the_cloud(running: Running, tmp_path: Path) -> None:
    result, client = result_of(running, tmp_path / "result"), running.client(("read",))
    cloud: Cloud = result.cloud
    before = [read(client, result, band) for band in range(BANDS)]
    path = copied(running, client, result)
    assert copies(running) == [path]
    assert path.stat().st_size == SIZE * cloud.n_points
    for band in range(BANDS):
        np.testing.assert_array_equal(read(client, result, band), before[band])
        np.testing.assert_array_equal(before[band], cloud.band(band))
    # They do come from there.
    stored = np.fromfile(path, np.uint16).reshape(BANDS, cloud.n_points)
    stored[3] = np.arange(cloud.n_points)
    stored.tofile(path)
    np.testing.assert_allclose(read(client, result, 3), cloud.decode(stored[3]))


def test_a_copy_that_is_cut_short_or_gone_is_not_needed(running: Running, tmp_path: Path) -> None:
    result, client = result_of(running, tmp_path / "result"), running.client(("read",))
    path = copied(running, client, result)
    path.write_bytes(path.read_bytes()[:-2])
    np.testing.assert_array_equal(read(client, result, 6), result.cloud.band(6))
    path.unlink()
    np.testing.assert_array_equal(read(client, result, 6), result.cloud.band(6))
    wait_for(path.is_file)


def test_copies_go_with_their_cloud(running: Running, tmp_path: Path) -> None:
    result, client = result_of(running, tmp_path / "result"), running.client(("read",))
    copied(running, client, result)
    (running.settings.scratch / band_copies.FOLDER / ".x.u2.00000000.tmp").write_bytes(b"under way")
    deleted = running.client(("admin",)).delete(f"/v1/acquisitions/{result.acquisition_id}")
    assert deleted.status_code == 204, deleted.text
    wait_for(lambda: [path.name for path in copies(running)] == [".x.u2.00000000.tmp"])


def test_copies_keep_to_their_bound_and_to_the_reserve(tmp_path: Path) -> None:
    with serving(tmp_path / "service", band_copies_bytes=SIZE * ROWS * COLS * 3 // 2) as running:
        client = running.client(("read",))
        first, second = (result_of(running, tmp_path / f"result {n}") for n in range(2))
        old = copied(running, client, first)
        new = copied(running, client, second)
        assert not old.exists()
        assert copies(running) == [new]
    cases: dict[str, dict[str, Any]] = {"none": {"band_copies_bytes": 0}, "full": {"min_free_bytes": 2**62}}
    for name, setting in cases.items():
        with serving(tmp_path / name, **setting) as running:
            result, client = result_of(running, tmp_path / f"result {name}"), running.client(("read",))
            np.testing.assert_array_equal(read(client, result, 1), result.cloud.band(1))
            time.sleep(0.5)
            assert copies(running) == []
