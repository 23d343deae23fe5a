"""Versions of a cloud's labels: writers at once, conditions, and the space that they take."""

from __future__ import annotations

import io
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa
from numpy.typing import NDArray

from specimap_infra.tables import LabelVersion
from tests.support.label_files import CLASSES, NPY, header, layer, npy
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def values(result: Result) -> NDArray[np.int64]:
    return np.random.default_rng(0).choice([0, 1, 700], result.cloud.n_points)


def test_versions_under_concurrent_writers(service: Running, result: Result, values: NDArray[np.int64]) -> None:
    clients = [service.client() for _ in range(8)]

    def write(number: int) -> httpx.Response:
        mine = values.copy()
        mine[number] = (mine[number] == 0) * 1
        return clients[number].put(
            layer(result),
            content=npy(mine),
            headers=header(classes=[*CLASSES, {"value": 5, "name": f"writer-{number}"}]),
        )

    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(write, range(8)))
    assert [a.status_code for a in answers] == [201] * 8
    assert sorted(a.json()["version"] for a in answers) == list(range(1, 9))
    listed = clients[0].get(layer(result) + "/versions").json()
    assert [item["version"] for item in listed] == list(range(8, 0, -1))
    for number, answer in enumerate(answers):
        mine = values.copy()
        mine[number] = (mine[number] == 0) * 1
        version = answer.json()["version"]
        read = clients[0].get(f"{layer(result)}/values?version={version}", headers={"Accept": NPY}).content
        np.testing.assert_array_equal(np.load(io.BytesIO(read)), mine)
        assert clients[0].get(f"{layer(result)}?version={version}").json()["classes"][-1]["name"] == f"writer-{number}"


def test_conditions(service: Running, result: Result, values: NDArray[np.int64]) -> None:
    client = service.client()

    def put(change: int, **conditions: str) -> tuple[int, Any]:
        mine = values.copy()
        mine[0] = change
        answer = client.put(layer(result), content=npy(mine), headers=header() | conditions)
        return answer.status_code, answer.json().get("version") or answer.json()["code"]

    assert put(0, **{"If-Match": "*"}) == (412, "precondition_failed")
    assert put(0, **{"If-None-Match": "*"}) == (201, 1)
    assert put(1, **{"If-None-Match": "*"}) == (412, "precondition_failed")
    assert put(1, **{"If-Match": '"2"'}) == (412, "precondition_failed")
    assert put(1, **{"If-Match": '"1"'}) == (201, 2)
    # The client did not hear the answer and sends it again: it is there, so all is well.
    assert put(1, **{"If-Match": '"1"'}) == (200, 2)
    assert put(0, **{"If-Match": '"1"'}) == (412, "precondition_failed")
    assert put(0, **{"If-Match": "2"}) == (201, 3)
    assert put(0, **{"If-Match": "soon"}) == (422, "request_invalid")
    # A weak tag equals none where content is to be replaced.
    assert put(1, **{"If-Match": 'W/"3"'}) == (412, "precondition_failed")
    assert put(1, **{"If-Match": 'W/"3", "3"'}) == (201, 4)


def test_conditions_of_deletion(service: Running, result: Result, values: NDArray[np.int64]) -> None:
    client = service.client()

    def delete(**conditions: str) -> int:
        return client.delete(layer(result), headers=conditions).status_code

    assert delete(**{"If-Match": '"1"'}) == 404
    for n in range(2):
        assert client.put(layer(result), content=npy(np.roll(values, n)), headers=header()).status_code == 201
    assert delete(**{"If-Match": '"1"'}) == 412
    assert delete(**{"If-Match": 'W/"2"'}) == 412
    assert delete(**{"If-Match": "soon"}) == 422
    assert len(client.get(f"{layer(result)}/versions").json()) == 2
    assert delete(**{"If-Match": '"2"'}) == 204
    assert client.get(layer(result)).status_code == 404
    assert client.put(layer(result), content=npy(values), headers=header()).status_code == 201
    assert delete(**{"If-Match": "*"}) == 204


def test_labels_count_against_the_quota(service: Running, result: Result, values: NDArray[np.int64]) -> None:
    client = service.client()
    assert client.put(layer(result), content=npy(values), headers=header()).status_code == 201
    with service.database.session() as session:
        size = session.scalar(sa.select(LabelVersion.size)) or 0
    folder = service.settings.data_dir / "storage" / "clouds" / result.cloud_id / "labels"
    # The attributes are added when the version is known.
    assert 0 < size <= sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) < size + 4096
    metrics = client.get("/metrics").text
    assert f'specimap_storage_use_bytes{{kind="labels"}} {size}.0' in metrics

    small = service.client(quota_bytes=2 * size + size // 2)
    for n in range(2):
        sent = small.put(layer(result, f"layer-{n}"), content=npy(values), headers=header())
        assert sent.status_code == 201, sent.text
    kept = sorted(folder.rglob("*"))
    for _ in range(2):
        sent = small.put(layer(result, "layer-2"), content=npy(values), headers=header())
        assert (sent.status_code, sent.json()["code"]) == (413, "quota_exceeded")
    assert sorted(folder.rglob("*")) == kept
    # The same again takes no place, and what is deleted gives its own back.
    assert small.put(layer(result, "layer-1"), content=npy(values), headers=header()).status_code == 200
    assert small.delete(layer(result, "layer-0")).status_code == 204
    assert small.put(layer(result, "layer-2"), content=npy(values), headers=header()).status_code == 201


def test_a_used_up_quota_is_said_before_the_body_is_read(service: Running, result: Result) -> None:
    client = service.client(quota_bytes=1)
    key_id = f"key_{client.headers['authorization'].split('_')[1]}"
    with service.database.session() as session:
        session.add(
            LabelVersion(
                cloud_id=result.cloud_id, name="x", version=1, kind="class", classes=[], made_by={"name": "test"},
                storage_prefix="x", sha256="0", size=1, created_by=key_id,
            )
        )  # fmt: skip
    answer = client.put(layer(result), content=b"no labels", headers=header())
    assert (answer.status_code, answer.json()["code"]) == (413, "quota_exceeded")


def test_labels_leave_the_reserve_of_the_disk(tmp_path: Path) -> None:
    with serving(tmp_path / "full", min_free_bytes=2**60) as service:
        result = put_result(service, tmp_path / "result")
        answer = service.client().put(layer(result), content=b"no labels", headers=header())
        assert (answer.status_code, answer.json()["code"]) == (507, "storage_full")
        assert not list(service.settings.scratch.glob("label-*"))
