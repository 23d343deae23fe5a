"""Which clouds there are, what is kept of them between requests, and what happens when they go."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from specimap_core.cloud import Cloud
from specimap_core.errors import NotFoundError
from specimap_infra.tables import Acquisition, CloudRow
from specimap_service.auth import keys
from specimap_service.clouds import open_clouds as clouds
from specimap_service.clouds.open_clouds import OpenClouds
from tests.support.result_scene import Result, put_label, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


def open_clouds(service: Running) -> OpenClouds:
    found: OpenClouds = service.app.state.open_clouds
    return found


# ---- what is told -----------------------------------------------------------------------------------------


def test_one_cloud(service: Running, result: Result) -> None:
    put_label(service, result, "tissue", np.zeros(result.cloud.n_points, np.uint8))
    reader = service.client(("read",))
    found, cloud = reader.get(f"/v1/clouds/{result.cloud_id}").json(), result.cloud
    assert {key: found[key] for key in ("id", "job_id", "acquisition_id", "points", "bands", "quantity")} == {
        "id": result.cloud_id,
        "job_id": result.job_id,
        "acquisition_id": result.acquisition_id,
        "points": cloud.n_points,
        "bands": 7,
        "quantity": "reflectance",
    }
    assert found["size"] == sum(p.stat().st_size for p in result.local.rglob("*") if p.is_file())
    np.testing.assert_allclose(found["wavelength_nm"], cloud.wavelengths_nm)
    np.testing.assert_allclose([found["low"], found["high"]], [cloud.xyz.min(0), cloud.xyz.max(0)], rtol=1e-6)
    assert (found["labels"], found["bad_bands"]) == (["tissue"], [2])
    for name in ("zarr", "previews", "labels", "exports"):
        assert found["links"][name].startswith(f"/v1/clouds/{result.cloud_id}/")
    assert found["links"]["report"] == f"/v1/jobs/{result.job_id}/report"
    assert reader.get(found["links"]["zarr"] + "/zarr.json").status_code == 200


def test_clouds_are_listed_newest_first_in_pages(service: Running, tmp_path: Path) -> None:
    first = put_result(service, tmp_path / "0", specimen_id="a")
    rest = [
        put_result(service, tmp_path / "1", acquisition_id=first.acquisition_id),
        put_result(service, tmp_path / "2", specimen_id="b"),
        put_result(service, tmp_path / "3", specimen_id="a"),
    ]
    ids = [result.cloud_id for result in (*reversed(rest), first)]
    reader, seen, after = service.client(("read",)), [], None
    while True:
        page = reader.get("/v1/clouds", params={"limit": 3} | ({"after": after} if after else {})).json()
        seen += [item["id"] for item in page["items"]]
        after = page["next"]
        if after is None:
            break
    assert seen == ids
    by_specimen = reader.get("/v1/clouds", params={"specimen_id": "a"}).json()["items"]
    assert [item["id"] for item in by_specimen] == [ids[0], ids[2], ids[3]]
    by_acquisition = reader.get("/v1/clouds", params={"acquisition_id": first.acquisition_id}).json()["items"]
    assert [item["id"] for item in by_acquisition] == ids[2:]
    assert reader.get("/v1/clouds", params={"specimen_id": "none"}).json() == {"items": [], "next": None}


@pytest.mark.parametrize("state", ["failed", "cancelled", "running"])
def test_results_of_jobs_that_did_not_succeed_do_not_exist(service: Running, tmp_path: Path, state: str) -> None:
    result = put_result(service, tmp_path / "result", state=state)
    reader, here = service.client(("read",)), f"/v1/clouds/{result.cloud_id}"
    assert reader.get("/v1/clouds").json()["items"] == []
    for path in (here, f"{here}/points/0", f"{here}/bands/0", f"{here}/zarr/zarr.json"):
        answer = reader.get(path)
        assert (answer.status_code, answer.json()["code"]) == (404, "not_found")
    assert reader.post(f"{here}/spectra", json={"select": {"indices": [0]}}).status_code == 404


def test_reading_needs_its_scope(service: Running, result: Result) -> None:
    other, here = service.client(("upload", "label")), f"/v1/clouds/{result.cloud_id}"
    for path in ("/v1/clouds", here, f"{here}/points/0", f"{here}/bands/0"):
        assert other.get(path).status_code == 403
    assert other.post(f"{here}/spectra", json={"select": {"indices": [0]}}).status_code == 403
    assert service.client(("read",)).get("/v1/clouds/cloud_1").status_code == 422


# ---- what is kept -----------------------------------------------------------------------------------------


def test_a_warm_spectrum_asks_no_database(service: Running, result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "KEPT_SECONDS", 600.0)
    monkeypatch.setattr(clouds, "KEPT_SECONDS", 600.0)
    reader = service.client(("read",))
    statements: list[str] = []

    def note(_: object, __: object, statement: str, *___: object) -> None:
        # The audit trail looks up the acquisition of what was read, in a thread of its own.
        if threading.current_thread().name != "audit":
            statements.append(statement)

    def read(index: int) -> None:
        reader.get(f"/v1/clouds/{result.cloud_id}/points/{index}").raise_for_status()
        body = {"select": {"indices": [index]}}
        reader.post(f"/v1/clouds/{result.cloud_id}/spectra", json=body).raise_for_status()

    engine = service.database.engine
    sa.event.listen(engine, "before_cursor_execute", note)
    try:
        read(0)
        assert any("clouds" in statement for statement in statements)
        statements.clear()
        for index in range(1, 20):
            read(index)
        assert [s for s in statements if "clouds" in s or "labels" in s or "api_keys" in s] == []
    finally:
        sa.event.remove(engine, "before_cursor_execute", note)


def test_a_cloud_asked_for_at_once_is_opened_once(
    service: Running, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, original = [], Cloud.open

    def slowly(group: Path) -> Cloud:
        opened.append(group)
        time.sleep(0.1)  # long enough for all threads to ask
        return original(group)

    monkeypatch.setattr(Cloud, "open", slowly)
    barrier = threading.Barrier(16)

    def read(_: int) -> int:
        barrier.wait()
        with open_clouds(service).reading(result.cloud_id) as (_record, cloud):
            return id(cloud)

    with ThreadPoolExecutor(16) as pool:
        assert len(set(pool.map(read, range(16)))) == 1
    assert len(opened) == 1


def test_a_failed_opening_is_tried_again(service: Running, result: Result) -> None:
    document = service.storage.path(f"{result.prefix}/cloud.zarr/xyz/zarr.json")
    assert document is not None
    content = document.read_bytes()
    document.unlink()
    reader = service.client(("read",))
    assert reader.get(f"/v1/clouds/{result.cloud_id}").json()["code"] == "cloud_damaged"
    document.write_bytes(content)
    assert reader.get(f"/v1/clouds/{result.cloud_id}").status_code == 200


def kept(service: Running, results: list[Result], monkeypatch: pytest.MonkeyPatch) -> list[bool]:
    """Open all in order, read an array of each, let go of what is too much; which are the same objects after."""
    monkeypatch.setattr(clouds, "_TRIM_SECONDS", 0.0)
    own, before = OpenClouds(service.storage, service.database), []
    for result in results:
        with own.reading(result.cloud_id) as (_, cloud):
            assert cloud.xyz.shape == (cloud.n_points, 3)
            before.append(cloud)
    with own.reading(results[-1].cloud_id) as (_, cloud):
        assert cloud is before[-1]
    return [
        opening is not None and opening.result() is cloud
        for opening, cloud in zip((own._clouds.get(r.cloud_id) for r in results), before, strict=True)
    ]


def test_clouds_used_longest_ago_are_let_go(service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = [put_result(service, tmp_path / str(i)) for i in range(4)]
    assert kept(service, results, monkeypatch) == [True] * 4
    monkeypatch.setattr(clouds, "MOST_CLOUDS", 3)
    assert kept(service, results, monkeypatch) == [False, True, True, True]
    monkeypatch.setattr(clouds, "MOST_BYTES", 2 * 12 * results[0].cloud.n_points)
    assert kept(service, results, monkeypatch) == [False, False, True, True]
    monkeypatch.setattr(clouds, "MOST_BYTES", 1)
    assert kept(service, results, monkeypatch) == [False, False, False, True]


# ---- what goes --------------------------------------------------------------------------------------------


def delete_rows(service: Running, result: Result) -> None:
    with service.database.session() as session:
        session.execute(sa.delete(Acquisition).where(Acquisition.id == result.acquisition_id))
        assert session.get(CloudRow, result.cloud_id) is None


@pytest.mark.slow
def test_a_deleted_cloud_is_gone_within_two_seconds(service: Running, result: Result) -> None:
    reader, here = service.client(("read",)), f"/v1/clouds/{result.cloud_id}"
    assert reader.get(f"{here}/points/3").status_code == 200
    delete_rows(service, result)
    deadline = time.monotonic() + clouds.KEPT_SECONDS + 1
    while reader.get(f"{here}/points/3").status_code == 200:
        assert time.monotonic() < deadline
    for path in (here, f"{here}/zarr/spectra/c/0/0", f"{here}/points/3"):
        assert reader.get(path).status_code == 404
    assert result.cloud_id not in open_clouds(service)._clouds


def test_a_cloud_deleted_while_it_is_read_is_not_found_rather_than_damaged(
    service: Running, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "KEPT_SECONDS", 600.0)
    reader = service.client(("read",))
    body = {"select": {"indices": [3]}}
    assert reader.post(f"/v1/clouds/{result.cloud_id}/spectra", json=body).status_code == 200
    delete_rows(service, result)
    service.storage.delete(result.prefix)
    answer = reader.post(f"/v1/clouds/{result.cloud_id}/spectra", json=body)
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")


def test_a_lookup_that_a_change_overtook_is_not_kept(
    service: Running, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    own, original = OpenClouds(service.storage, service.database), OpenClouds._look_up

    def overtaken(self: OpenClouds, cloud_id: str) -> clouds.CloudRecord:
        found = original(self, cloud_id)
        delete_rows(service, result)
        self.forget(cloud_id)
        return found

    monkeypatch.setattr(OpenClouds, "_look_up", overtaken)
    assert own.record(result.cloud_id).id == result.cloud_id
    monkeypatch.setattr(OpenClouds, "_look_up", original)
    with pytest.raises(NotFoundError):
        own.record(result.cloud_id)


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["shard", "index", "group", "metadata"])
def test_a_damaged_cloud_says_so_without_naming_files(service: Running, result: Result, damage: str) -> None:
    name = {"shard": "spectra/c/0/0", "index": "spectra/c/0/0", "group": "zarr.json", "metadata": "flags/zarr.json"}
    path = service.storage.path(f"{result.prefix}/cloud.zarr/{name[damage]}")
    assert path is not None
    content = path.read_bytes()
    path.write_bytes({"shard": b"", "index": content[:-9] + b"x" * 9, "group": b"{", "metadata": b"[]"}[damage])
    reader, here = service.client(("read",)), f"/v1/clouds/{result.cloud_id}"
    answers = [
        reader.post(f"{here}/spectra", json={"select": {"indices": [3]}}),
        reader.get(f"{here}/points/3"),
        reader.get(f"{here}/bands/3"),
    ]
    answers += [reader.get(f"{here}/zarr/zarr.json")] if damage in ("group", "metadata") else []
    for answer in answers:
        assert (answer.status_code, answer.json()["code"]) == (500, "cloud_damaged")
        assert answer.json()["advice"]
        assert str(service.settings.data_dir) not in answer.text
        assert result.prefix not in answer.text
