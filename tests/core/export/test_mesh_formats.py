"""A run's mesh in other formats, as other programs read it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from specimap_core.errors import CloudDamagedError, SettingsError
from specimap_core.native import open3d
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.mesh_files import MESH_WRITERS, export_mesh, read_mesh_ply, write_mesh_ply


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    """A bumpy sheet of 40 x 30 vertices, coloured at random."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[:30, :40].astype(np.float32)
    vertices = np.stack([x, y, np.sin(x / 5) * 3], -1).reshape(-1, 3) * np.float32(0.7)
    at = (np.arange(29)[:, None] * 40 + np.arange(39)).ravel()
    triangles = np.concatenate([np.stack([at, at + 1, at + 40], 1), np.stack([at + 1, at + 41, at + 40], 1)])
    normals = rng.normal(size=vertices.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colours = rng.integers(0, 256, vertices.shape, dtype=np.uint8)
    return Mesh(vertices, triangles.astype(np.int32), normals.astype(np.float32), colours)


@pytest.fixture(scope="module")
def ply(mesh: Mesh, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "mesh.ply"
    write_mesh_ply(path, mesh)
    return path


def test_ply_reads_back(mesh: Mesh, ply: Path) -> None:
    back = read_mesh_ply(ply)
    for name, values in vars(mesh).items():
        np.testing.assert_array_equal(getattr(back, name), values)
        assert getattr(back, name).dtype == values.dtype


@pytest.mark.slow
def test_stl(mesh: Mesh, ply: Path, tmp_path: Path) -> None:
    path = export_mesh(ply, tmp_path / "m.stl", "stl")
    assert path.stat().st_size == 84 + 50 * len(mesh.triangles)
    read = open3d().io.read_triangle_mesh(str(path))
    soup = np.asarray(read.vertices)[np.asarray(read.triangles)]
    np.testing.assert_array_equal(soup.astype(np.float32), mesh.vertices[mesh.triangles])
    loaded = trimesh.load_mesh(path)
    # The sheet's triangles turn the same way: their normals point to +z.
    stored = np.frombuffer(path.read_bytes()[84:], "<f4,<f4,<f4,V38")
    np.testing.assert_allclose(np.stack([stored[f"f{i}"] for i in range(3)], 1), loaded.face_normals, atol=1e-5)
    assert (loaded.face_normals[:, 2] > 0).all()


def test_stl_of_a_triangle_without_area_has_no_normal(tmp_path: Path) -> None:
    flat = Mesh(
        np.zeros((3, 3), np.float32),
        np.array([[0, 1, 2]], np.int32),
        np.zeros((3, 3), np.float32),
        np.zeros((3, 3), np.uint8),
    )
    write_mesh_ply(tmp_path / "flat.ply", flat)
    written = export_mesh(tmp_path / "flat.ply", tmp_path / "flat.stl", "stl").read_bytes()
    assert written[84:] == bytes(50)


def test_obj(mesh: Mesh, ply: Path, tmp_path: Path) -> None:
    path = export_mesh(ply, tmp_path / "m.obj", "obj")
    read = open3d().io.read_triangle_mesh(str(path))
    # Open3D numbers the vertices anew: compared corner by corner.
    theirs, ours = np.asarray(read.triangles), mesh.triangles
    np.testing.assert_allclose(np.asarray(read.vertices)[theirs], mesh.vertices[ours], atol=0.51e-5)
    np.testing.assert_array_equal(np.rint(np.asarray(read.vertex_colors)[theirs] * 255), mesh.colours[ours])
    np.testing.assert_allclose(np.asarray(read.vertex_normals)[theirs], mesh.normals[ours], atol=1e-4)


def glb_parts(path: Path) -> tuple[dict[str, object], bytes]:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    binary, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert 28 + size + binary == len(data)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_glb(mesh: Mesh, ply: Path, tmp_path: Path) -> None:
    path = export_mesh(ply, tmp_path / "m.glb", "glb")
    scene = trimesh.load_scene(path)
    (loaded,) = scene.geometry.values()
    np.testing.assert_array_equal(loaded.faces, mesh.triangles)
    np.testing.assert_allclose(loaded.vertices, mesh.vertices / 1000, atol=1e-8)
    np.testing.assert_allclose(loaded.vertex_normals, mesh.normals, atol=1e-6)
    # As placed in the scene: metres, the marker frame's z up, which is glTF's y.
    placed = np.asarray(scene.to_mesh().vertices)
    x, y, z = mesh.vertices.T / 1000
    np.testing.assert_allclose(placed, np.stack([x, z, -y], 1), atol=1e-8)
    document, binary = glb_parts(path)
    accessor = document["accessors"][2]  # type: ignore[index]
    assert (accessor["componentType"], accessor["type"], accessor["normalized"]) == (5123, "VEC4", True)
    view = document["bufferViews"][accessor["bufferView"]]  # type: ignore[index]
    linear = np.frombuffer(binary, "<u2", 4 * len(mesh.vertices), view["byteOffset"]).reshape(-1, 4)
    assert (linear[:, 3] == 65535).all()
    np.testing.assert_array_equal(to_srgb(linear[:, :3] / 65535), mesh.colours)


def to_srgb(linear: NDArray[np.float64]) -> NDArray[np.uint8]:
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(encoded * 255), np.uint8)


@pytest.mark.parametrize("format", list(MESH_WRITERS))
def test_formats_are_whole_or_absent(ply: Path, tmp_path: Path, format: str) -> None:
    target = tmp_path / f"m.{format}"
    first = export_mesh(ply, target, format).read_bytes()
    broken = tmp_path / "broken.ply"
    broken.write_bytes(ply.read_bytes()[:-5])
    with pytest.raises(CloudDamagedError, match=r"broken\.ply"):
        export_mesh(broken, target, format)
    assert target.read_bytes() == first
    assert sorted(path.name for path in tmp_path.iterdir()) == ["broken.ply", target.name]


@pytest.mark.parametrize(
    "content", [b"", b"ply\nformat ascii 1.0\nend_header\n", b"\xff" * 3000, b"element vertex -1\n" * 20]
)
def test_other_files_are_no_mesh_of_a_run(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "mesh.ply"
    path.write_bytes(content)
    with pytest.raises(CloudDamagedError):
        read_mesh_ply(path)
    with pytest.raises(CloudDamagedError):
        read_mesh_ply(tmp_path / "absent.ply")


def test_unknown_format(ply: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="stl, obj, glb"):
        export_mesh(ply, tmp_path / "m.fbx", "fbx")
