"""Exports: asked for once, made by a worker's function in a process of its own, served in ranges, never half."""

from __future__ import annotations

import io
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import laspy
import numpy as np
import pytest
import sqlalchemy as sa
import trimesh
import xarray
import zarr

from specimap_core.cloud import Cloud
from specimap_core.export.formats import DEIDENTIFIED, KINDS, FileFormat
from specimap_core.native import open3d
from specimap_core.surface.mesh_files import read_mesh_ply
from specimap_infra.queue import EXPORTS, MAKE_EXPORT
from specimap_workers.export_main import make_export_file
from tests.support.export_scene import address, make
from tests.support.label_files import header, layer, npy
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def client(service: Running) -> httpx.Client:
    return service.client()


def made(service: Running, client: httpx.Client, result: Result, format: str) -> bytes:
    """The file's content, made as a worker makes it."""
    asked = client.post(address(result, format))
    assert asked.status_code == 202
    make(service, asked.json()["id"])
    export = client.get(address(result, format)).json()
    assert (export["state"], export["error"]) == ("succeeded", None), export
    answer = client.get(export["links"]["content"])
    assert answer.status_code == 200
    assert export["size"] == len(answer.content)
    suffix = KINDS[FileFormat(format)].suffix
    assert answer.headers["content-disposition"] == f'attachment; filename="{result.cloud_id}.{suffix}"'
    return answer.content


def queued(service: Running) -> list[tuple[str, str, str, int]]:
    """Id, workflow, queue and priority of what waits at the engine."""
    with service.database.session() as session:
        rows = session.execute(sa.text("SELECT workflow_uuid, name, queue_name, priority FROM workflow_status"))
        return [(row[0], row[1], row[2], row[3]) for row in rows]


# ---- asking -------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_format_is_asked_for_once(service: Running, client: httpx.Client, result: Result) -> None:
    clients = [service.client(["read"]) for _ in range(6)]
    with ThreadPoolExecutor(6) as pool:
        answers = list(pool.map(lambda c: c.post(address(result, "las")), clients))
    assert {answer.status_code for answer in answers} == {202}
    (export_id,) = {answer.json()["id"] for answer in answers}
    export = answers[0].json()
    assert (export["state"], export["size"], export["format"]) == ("queued", None, "las")
    assert queued(service) == [(export_id, MAKE_EXPORT, EXPORTS, 5)]
    refused = client.get(export["links"]["content"])
    assert (refused.status_code, refused.json()["code"]) == (409, "state_conflict")
    assert refused.json()["details"] == {"state": "queued"}
    assert client.get(address(result, "las")).json() == export
    assert [item["format"] for item in client.get(address(result, "").rstrip("/")).json()] == ["las", "mesh-ply"]
    audited = client.get("/v1/audit", params={"target": export_id}).json()["items"]
    assert [(e["action"], e["details"]) for e in audited] == [
        ("export.create", {"cloud": result.cloud_id, "format": "las"})
    ]
    make(service, export_id)
    repeated = client.post(address(result, "las"))
    assert (repeated.status_code, repeated.json()["id"], repeated.json()["state"]) == (200, export_id, "succeeded")
    assert len(queued(service)) == 1


def test_the_mesh_is_there_without_being_made(service: Running, client: httpx.Client, result: Result) -> None:
    asked = client.post(address(result, "mesh-ply"))
    assert (asked.status_code, asked.json()["state"]) == (200, "succeeded")
    assert queued(service) == []
    content = client.get(asked.json()["links"]["content"]).content
    assert content == (result.local / "mesh.ply").read_bytes()
    assert asked.json()["size"] == len(content)


def test_what_cannot_be_asked_for(service: Running, client: httpx.Client, result: Result) -> None:
    assert client.post(address(result, "dwg")).status_code == 422
    assert client.get(address(result, "csv")).json()["code"] == "not_found"
    assert client.get(address(result, "csv") + "/content").json()["code"] == "not_found"
    assert client.post(f"/v1/clouds/cloud_{'0' * 26}/exports/csv").json()["code"] == "not_found"
    assert service.client(["upload"]).post(address(result, "csv")).status_code == 403


# ---- the files ----------------------------------------------------------------------------------------


def test_las(service: Running, client: httpx.Client, result: Result) -> None:
    las = laspy.read(io.BytesIO(made(service, client, result, "las")))
    assert np.abs(las.xyz - result.cloud.xyz).max() <= 0.00051
    np.testing.assert_array_equal(np.stack([las["hsi_row"], las["hsi_col"]], 1), result.cloud.hsi_pixel)


@pytest.mark.slow
def test_npz_and_csv(service: Running, client: httpx.Client, result: Result) -> None:
    cloud = result.cloud
    with np.load(io.BytesIO(made(service, client, result, "npz"))) as held:
        np.testing.assert_array_equal(held["spectra"], cloud.stored_spectra(slice(None)))
        np.testing.assert_array_equal(held["xyz"], cloud.xyz)
    table = np.loadtxt(io.BytesIO(made(service, client, result, "csv")), delimiter=",", skiprows=1)
    np.testing.assert_array_equal(np.rint(table[:, 13:] * 1e4), cloud.stored_spectra(slice(None)))


@pytest.mark.slow
def test_ply_and_meshes(service: Running, client: httpx.Client, result: Result, tmp_path: Path) -> None:
    def stored(format: str, name: str) -> Path:
        path = tmp_path / name
        path.write_bytes(made(service, client, result, format))
        return path

    io3d, mesh = open3d().io, read_mesh_ply(result.local / "mesh.ply")
    points = np.asarray(io3d.read_point_cloud(str(stored("ply", "c.ply"))).points)
    np.testing.assert_array_equal(points.astype(np.float32), result.cloud.xyz)
    soup = mesh.vertices[mesh.triangles]
    for format in ("stl", "obj"):
        read = io3d.read_triangle_mesh(str(stored(f"mesh-{format}", f"m.{format}")))
        np.testing.assert_allclose(np.asarray(read.vertices)[np.asarray(read.triangles)], soup, atol=1e-5)
    (glb,) = trimesh.load_scene(stored("mesh-glb", "m.glb")).geometry.values()
    assert isinstance(glb, trimesh.Trimesh)
    np.testing.assert_allclose(glb.vertices[glb.faces] * 1000, soup, atol=1e-4)


@pytest.mark.slow
def test_envi(service: Running, client: httpx.Client, result: Result, tmp_path: Path) -> None:
    import spectral.io.envi

    with zipfile.ZipFile(io.BytesIO(made(service, client, result, "envi"))) as archive:
        assert archive.namelist() == ["cloud.hdr", "cloud.bil"]
        archive.extractall(tmp_path / "envi")
    opened = spectral.io.envi.open(str(tmp_path / "envi" / "cloud.hdr"), str(tmp_path / "envi" / "cloud.bil"))
    cube = np.asarray(opened.open_memmap(interleave="bip"))
    cloud = result.cloud
    x, y, z = cloud.xyz.T
    near = (np.abs(x - x.min()) < 0.25) & (np.abs(y - y.min()) < 0.25)
    near &= z >= z[near].max() - 1
    mean = cloud.stored_spectra(np.flatnonzero(near)).mean(0)
    assert np.abs(cube[-1, 0] - mean).max() <= 0.51


@pytest.mark.slow
def test_zarr_opens_as_it_is_with_its_labels(
    service: Running, client: httpx.Client, result: Result, tmp_path: Path
) -> None:
    cloud = result.cloud
    values = np.random.default_rng(0).choice([0, 1, 700], cloud.n_points)
    assert client.put(layer(result), content=npy(values), headers=header()).status_code == 201
    path = tmp_path / "cloud.zarr.zip"
    path.write_bytes(made(service, client, result, "zarr"))
    with zipfile.ZipFile(path) as archive:
        assert {item.compress_type for item in archive.infolist()} == {zipfile.ZIP_STORED}
        assert archive.testzip() is None
        archive.extractall(tmp_path / "unpacked")
    with zarr.storage.ZipStore(path, mode="r") as store:
        group = zarr.open_group(store, mode="r")
        np.testing.assert_array_equal(np.asarray(group["spectra"]), cloud.stored_spectra(slice(None)))
        assert sorted(group["labels"].array_keys()) == ["tissue"]  # type: ignore[union-attr]
        np.testing.assert_array_equal(np.asarray(group["labels/tissue"]), values)
        with xarray.open_zarr(store, consolidated=False) as data:
            np.testing.assert_array_equal(data["xyz"], cloud.xyz)
    unpacked = Cloud.open(tmp_path / "unpacked")
    np.testing.assert_array_equal(unpacked.label("tissue"), values)

    # Once made, it stays, until the labels are others than those in it.
    first = client.get(address(result, "zarr")).json()
    assert client.post(address(result, "zarr")).json() == first
    client.put(layer(result, "second"), content=npy(values), headers=header())
    asked = client.post(address(result, "zarr"))
    assert (asked.status_code, asked.json()["state"]) == (202, "queued")
    assert asked.json()["id"] != first["id"]
    make(service, asked.json()["id"])
    archive = zipfile.ZipFile(io.BytesIO(client.get(address(result, "zarr") + "/content").content))
    assert {"labels/zarr.json", "labels/tissue/zarr.json", "labels/second/c/0"} <= set(archive.namelist())
    assert len(list((service.settings.data_dir / "storage" / "exports").rglob("*.zip"))) == 1


def test_content_in_ranges(service: Running, client: httpx.Client, result: Result) -> None:
    whole = made(service, client, result, "npz")
    place = address(result, "npz") + "/content"
    head = client.head(place)
    assert (head.status_code, head.content, int(head.headers["content-length"])) == (200, b"", len(whole))
    part = client.get(place, headers={"Range": "bytes=100-199"})
    assert (part.status_code, part.content) == (206, whole[100:200])
    assert part.headers["content-range"] == f"bytes 100-199/{len(whole)}"
    assert client.get(place, headers={"Range": "bytes=-50"}).content == whole[-50:]
    assert client.get(place, headers={"If-None-Match": head.headers["etag"]}).status_code == 304
    assert client.get(place, headers={"Range": f"bytes={len(whole)}-"}).status_code == 416


@pytest.mark.slow
def test_formats_of_the_function_and_unknown_ones(result: Result, tmp_path: Path) -> None:
    for format in set(FileFormat) - DEIDENTIFIED:  # these need a plan of pseudonyms
        assert make_export_file(result.local, format.value, tmp_path / format.value).is_file()
    with pytest.raises(ValueError, match="dwg"):
        make_export_file(result.local, "dwg", tmp_path / "x")
