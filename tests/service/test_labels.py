"""Label layers: written in every encoding, versioned under concurrency, read back exactly, refused with reasons."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from specimap_core.cloud import Cloud
from specimap_core.cloud.labels import GROUP_DOCUMENT
from specimap_infra.audit.entries import name_digest
from tests.support.label_files import ARROW, CLASSES, MODEL, NPY, header, layer, npy
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def values(result: Result) -> NDArray[np.int64]:
    return np.random.default_rng(0).choice([0, 1, 700], result.cloud.n_points)


def arrow(columns: dict[str, Any], compression: str | None = None, rows: int | None = None) -> bytes:
    table = pa.table(columns)
    out = io.BytesIO()
    with pa.ipc.new_stream(out, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as writer:
        writer.write_table(table, max_chunksize=rows)
    return out.getvalue()


def test_classes_round_trip_in_all_encodings(
    service: Running, result: Result, values: NDArray[np.int64], tmp_path: Path
) -> None:
    client = service.client()
    made = client.put(layer(result), content=npy(values), headers=header())
    assert made.status_code == 201, made.text
    label = made.json()
    assert (label["version"], label["kind"], label["made_by"]) == (1, "class", MODEL)
    assert label["classes"] == [{"colour": None, **item} for item in CLASSES]
    assert made.headers["etag"] == '"1"'
    # The same content in another encoding is the same version.
    again = client.put(
        layer(result),
        content=arrow({"value": values.astype(np.int16)}, rows=1000),
        headers=header() | {"Content-Type": ARROW},
    )
    assert (again.status_code, again.json()) == (200, label)
    assert client.get(layer(result)).json() == label
    assert client.get(f"/v1/clouds/{result.cloud_id}/labels").json() == [label]

    read = client.get(label["links"]["values"], headers={"Accept": NPY})
    assert int(read.headers["content-length"]) == len(read.content)
    loaded = np.load(io.BytesIO(read.content))
    assert loaded.dtype == np.uint16
    np.testing.assert_array_equal(loaded, values)
    table = pa.ipc.open_stream(client.get(label["links"]["values"], headers={"Accept": ARROW}).content).read_all()
    assert table.column_names == ["value"]
    np.testing.assert_array_equal(table["value"].to_numpy(), values)
    plain = client.get(label["links"]["values"]).json()
    assert plain["values"] == values.tolist()
    assert plain["version"] == 1

    # As it lies in the storage it belongs into a cloud's folder: Specimap's own reader finds it there.
    local = tmp_path / "result" / "cloud.zarr"
    (prefix,) = (p for p in (service.settings.data_dir / "storage" / "clouds").rglob("v1-*") if p.is_dir())
    (local / "labels").mkdir()
    prefix.rename(local / "labels" / "tissue")
    (local / "labels" / "zarr.json").write_bytes(GROUP_DOCUMENT)
    cloud = Cloud.open(local)
    assert cloud.label_names == ("tissue",)
    np.testing.assert_array_equal(cloud.label("tissue"), values)
    document = json.loads((local / "labels" / "tissue" / "zarr.json").read_text())
    assert document["attributes"] == {"kind": "class", "classes": CLASSES, "made_by": MODEL, "version": 1}
    assert document["dimension_names"] == ["point"]


def test_probabilities_round_trip(service: Running, result: Result) -> None:
    client, points = service.client(), result.cloud.n_points
    chances = np.random.default_rng(1).random((points, 3)).astype(np.float32)
    chances[5, 1] = np.nan
    columns: dict[str, Any] = {c["name"]: chances[:, i] for i, c in enumerate(CLASSES)}
    columns["tumour"] = pa.array([None if np.isnan(v) else v for v in chances[:, 1]], pa.float32())
    reordered = {name: columns[name] for name in ("healthy", "unlabelled", "tumour")}
    kind = header("probability")
    assert client.put(layer(result), content=npy(chances), headers=kind).status_code == 201
    same = client.put(layer(result), content=arrow(reordered, rows=777), headers=kind | {"Content-Type": ARROW})
    assert same.status_code == 200
    read = client.get(layer(result) + "/values", headers={"Accept": NPY}).content
    np.testing.assert_array_equal(np.load(io.BytesIO(read)), chances)
    table = pa.ipc.open_stream(client.get(layer(result) + "/values", headers={"Accept": ARROW}).content).read_all()
    assert table.column_names == ["unlabelled", "tumour", "healthy"]
    np.testing.assert_array_equal(table["healthy"].to_numpy(), chances[:, 2])
    plain = client.get(layer(result) + "/values").json()["values"]
    assert plain[5][1] is None
    assert plain[6] == pytest.approx(chances[6])

    alone = header("probability", [])
    for number, content in enumerate((npy(chances[:, 0].astype(np.float64)), arrow({"probability": chances[:, 2]}))):
        kind = alone | {"Content-Type": NPY if number == 0 else ARROW}
        answer = client.put(layer(result, "chance"), content=content, headers=kind)
        assert (answer.status_code, answer.json()["version"]) == (201, number + 1)
    read = client.get(layer(result, "chance") + "/values?version=1", headers={"Accept": NPY}).content
    np.testing.assert_array_equal(np.load(io.BytesIO(read)), chances[:, 0])


def wrong_bodies() -> list[tuple[str, str, dict[str, str], Callable[[NDArray[np.int64]], bytes]]]:
    """Code, media type, headers, body from right values."""
    probability = header("probability", [])
    return [
        ("label_invalid", NPY, header(), lambda v: npy(v[:-1])),
        ("label_invalid", NPY, header(), lambda v: npy(np.append(v, 0))),
        ("label_invalid", NPY, header(), lambda v: npy(np.where(np.arange(len(v)) == 9, 2, v))),
        ("label_invalid", NPY, header(), lambda v: npy(np.where(np.arange(len(v)) == 9, -1, v))),
        ("label_invalid", NPY, header(), lambda v: npy(v.astype(float))),
        ("label_invalid", NPY, header(), lambda v: npy(np.stack([v, v], 1))),
        ("label_invalid", NPY, probability, lambda v: npy(np.full(len(v), 1.01))),
        ("label_invalid", NPY, probability, lambda v: npy(np.full(len(v), -0.01))),
        ("label_invalid", NPY, probability, lambda v: npy(np.full(len(v), np.inf))),
        ("label_invalid", NPY, header("probability"), lambda v: npy(np.zeros((len(v), 2)))),
        ("label_invalid", NPY, header("probability"), lambda v: npy(np.zeros(len(v)))),
        ("label_invalid", ARROW, header(), lambda v: arrow({"value": pa.array([None, *v[1:].tolist()])})),
        ("label_invalid", ARROW, header(), lambda v: arrow({"value": v, "probability": v / 700})),
        ("label_invalid", ARROW, header(), lambda v: arrow({"class": v})),
        ("label_invalid", ARROW, header(), lambda v: arrow({"value": v[:-1]})),
        ("label_invalid", ARROW, header(), lambda v: arrow({"value": np.append(v, 0)})),
        ("label_invalid", ARROW, header("probability"), lambda v: arrow({"tumour": v / 700})),
        ("request_invalid", ARROW, header(), lambda v: arrow({"value": v}, "zstd")),
        ("request_invalid", ARROW, header(), lambda v: arrow({"value": v}, "lz4")),
        ("request_invalid", ARROW, header(), lambda v: arrow({"value": [str(i) for i in v]})),
        ("request_invalid", ARROW, header(), lambda v: arrow({"value": pa.array(v).dictionary_encode()})),
        ("request_invalid", ARROW, header(), lambda v: arrow({"value": v})[:-300]),
        ("request_invalid", ARROW, header(), lambda v: npy(v)),
        ("request_invalid", NPY, header(), lambda v: arrow({"value": v})),
        ("request_invalid", NPY, header(), lambda v: npy(v)[:-1]),
        ("request_invalid", NPY, header(), lambda v: npy(np.array([{}] * len(v)))),
        ("request_invalid", NPY, header(), lambda v: b""),
        ("request_invalid", NPY, header(), lambda v: npy(v).replace(b"}", b" ", 1)),
        ("request_invalid", ARROW, header(), lambda v: b""),
        ("request_invalid", ARROW, header(), lambda v: b"\xff\xff\xff\xff\0\0\0\0"),
        ("request_invalid", ARROW, header(), lambda v: b"\xff\xff\xff\xff\xff\xff\xff\x7f"),
        ("request_invalid", NPY, header(kind="colour"), npy),
        ("request_invalid", NPY, header(classes=[]), npy),
        ("request_invalid", NPY, header(classes=[*CLASSES, CLASSES[0]]), npy),
        ("request_invalid", NPY, header(classes=[{"value": 0, "name": "a", "colour": "red"}]), npy),
        ("request_invalid", NPY, header(more=1), npy),
        ("request_invalid", NPY, {"X-Specimap-Label": "{"}, npy),
        ("request_invalid", NPY, {}, npy),
        ("media_type_unsupported", "text/csv", header(), npy),
        ("payload_too_large", NPY, header(), lambda v: npy(v) + bytes(2 * 1024 * 1024)),
    ]


@pytest.mark.slow
def test_what_does_not_fit_is_refused_and_leaves_nothing(
    service: Running, result: Result, values: NDArray[np.int64]
) -> None:
    client = service.client()
    status = {"media_type_unsupported": 415, "payload_too_large": 413}
    for number, (code, media, headers, body) in enumerate(wrong_bodies()):
        answer = client.put(layer(result), content=body(values), headers=headers | {"Content-Type": media})
        assert (number, answer.status_code, answer.json()["code"]) == (number, status.get(code, 422), code), answer.text
        assert str(service.settings.data_dir) not in answer.text
        assert answer.json()["advice"]
    # Without a length in advance the body is counted as it comes.
    streamed = client.put(layer(result), content=iter([bytes(1 << 20)] * 4), headers=header())
    assert streamed.json()["code"] == "payload_too_large"
    assert client.get(f"/v1/clouds/{result.cloud_id}/labels").json() == []
    assert not list(service.settings.scratch.glob("label-*"))
    assert not list((service.settings.data_dir / "storage").rglob("v1-*"))
    ninth = np.where(np.arange(len(values)) == 9, 2, values)
    refused = client.put(layer(result), content=npy(ninth), headers=header()).json()
    assert (refused["details"]["point"], refused["details"]["count"]) == (9, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Tissue", "a b", "a" * 65, "a.b", "%2e%2e", "ä"])
def test_names_are_safe(service: Running, result: Result, name: str) -> None:
    answer = service.client().put(layer(result, name), content=b"", headers=header())
    assert answer.status_code in (404, 422)


def test_scopes_audit_and_deletion(service: Running, result: Result, values: NDArray[np.int64]) -> None:
    admin, labeller, reader = service.client(), service.client(["label"]), service.client(["read"])
    assert reader.put(layer(result), content=npy(values), headers=header()).status_code == 403
    assert labeller.put(layer(result), content=npy(values), headers=header()).status_code == 201
    values[0] = 0 if values[0] else 1
    label = labeller.put(layer(result), content=npy(values), headers=header()).json()
    assert labeller.get(layer(result)).status_code == 403
    assert reader.get(layer(result)).json() == label
    assert reader.delete(layer(result)).status_code == 403
    folder = service.settings.data_dir / "storage" / "clouds" / result.cloud_id
    assert len(list(folder.rglob("zarr.json"))) == 2
    assert labeller.delete(layer(result)).status_code == 204
    assert not list(folder.rglob("zarr.json"))
    for path in ("", "/values", "/versions", "?version=1"):
        assert reader.get(layer(result) + path).json()["code"] == "not_found"
    assert labeller.delete(layer(result)).status_code == 404
    # A layer of the same name begins anew.
    assert labeller.put(layer(result), content=npy(values), headers=header()).json()["version"] == 1
    np.testing.assert_array_equal(reader.get(layer(result) + "/values").json()["values"], values)
    audited = admin.get("/v1/audit", params={"target": result.cloud_id}).json()["items"]
    digest = name_digest(result.cloud_id, "tissue")
    assert [(entry["action"], entry["details"]) for entry in audited] == [
        ("label.put", {"layer": digest, "version": 1}),
        ("label.delete", {"layer": digest, "versions": 2}),
        ("label.put", {"layer": digest, "version": 2}),
        ("label.put", {"layer": digest, "version": 1}),
    ]
    assert {entry["key_id"] for entry in audited} == {label["created_by"]}


def test_unknown_cloud(service: Running) -> None:
    client, nowhere = service.client(), f"/v1/clouds/cloud_{'0' * 26}/labels"
    assert client.get(nowhere).json()["code"] == "not_found"
    assert client.put(f"{nowhere}/a", content=npy(np.zeros(3, int)), headers=header()).json()["code"] == "not_found"
    assert client.delete(f"{nowhere}/a").json()["code"] == "not_found"
