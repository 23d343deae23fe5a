"""A mesh as a file: binary PLY, which every 3D program reads, and from it STL, OBJ and GLB."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.atomic import atomic_path
from specimap_core.errors import CloudDamagedError, SettingsError
from specimap_core.json_text import json_text
from specimap_core.photos.colour import linear_from_srgb
from specimap_core.surface.fusion import Mesh

_VERTEX = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
_FACE = np.dtype([("count", "u1"), ("i", "<i4", 3)])
_HEADER = (
    "ply\nformat binary_little_endian 1.0\ncomment millimetres, marker frame\nelement vertex {vertices}\n"
    + "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz"))
    + "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
    + "element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
)
# Rows put into text or records at a time: bounds what is needed besides the mesh itself.
_TOGETHER = 65536
_METRES = 0.001


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Write vertices (mm, marker frame) with normals and colours, and triangles; little-endian, atomic."""
    vertices = np.empty(len(mesh.vertices), _VERTEX)
    vertices["p"], vertices["n"], vertices["c"] = mesh.vertices, mesh.normals, mesh.colours
    faces = np.empty(len(mesh.triangles), _FACE)
    faces["count"], faces["i"] = 3, mesh.triangles
    with atomic_path(path) as aside, open(aside, "wb") as f:
        f.write(_HEADER.format(vertices=len(vertices), faces=len(faces)).encode("ascii"))
        f.write(vertices.tobytes())
        f.write(faces.tobytes())


def read_mesh_ply(path: Path) -> Mesh:
    """Read what :func:`write_mesh_ply` wrote.

    Raises:
        CloudDamagedError: it is another file, or not whole.
    """
    try:
        with open(path, "rb") as f:
            lines = [f.readline(200).decode("ascii").strip() for _ in range(len(_HEADER.splitlines()))]
            counts = {words[1]: int(words[2]) for words in map(str.split, lines) if words[:1] == ["element"]}
            n_vertices, n_faces = counts["vertex"], counts["face"]
            if lines != _HEADER.format(vertices=n_vertices, faces=n_faces).splitlines():
                raise ValueError("the header is another")
            vertices = np.fromfile(f, _VERTEX, n_vertices)
            faces = np.fromfile(f, _FACE, n_faces)
        if (len(vertices), len(faces)) != (n_vertices, n_faces) or (faces["count"] != 3).any():
            raise ValueError("it is not whole")
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise CloudDamagedError(f"The mesh {path.name} cannot be read: {error}.", advice="Repeat the run.") from error
    return Mesh(*(np.ascontiguousarray(values) for values in (vertices["p"], faces["i"], vertices["n"], vertices["c"])))


def export_mesh(mesh_ply: Path, target: Path, format: str) -> Path:
    """Write the mesh of a run to ``target`` as ``stl``, ``obj`` or ``glb``, replacing it.

    STL and OBJ are in mm; GLB is in metres, as glTF wants it, and turned so that the marker frame's z is up.

    Raises:
        SettingsError: another format.
        CloudDamagedError: the mesh does not read.
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    writer = MESH_WRITERS.get(format)
    if writer is None:
        raise SettingsError(
            f"There is no mesh format {format!r}.",
            advice=f"Choose one of {', '.join(MESH_WRITERS)}.",
            setting="format",
            choices=list(MESH_WRITERS),
        )
    mesh = read_mesh_ply(mesh_ply)
    with atomic_path(target) as aside, open(aside, "wb") as file:
        writer(file, mesh)
    return target


def _write_stl(file: BinaryIO, mesh: Mesh) -> None:
    """Binary STL: triangles with their own normals; it knows neither colours nor shared vertices."""
    file.write(b"Specimap: millimetres, marker frame".ljust(80) + struct.pack("<I", len(mesh.triangles)))
    record = np.dtype([("n", "<f4", 3), ("p", "<f4", (3, 3)), ("attribute", "<u2")])
    for rows in _blocks(len(mesh.triangles)):
        corners = mesh.vertices[mesh.triangles[rows]]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        records = np.zeros(len(corners), record)
        records["p"] = corners
        records["n"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        file.write(records.tobytes())


def _write_obj(file: BinaryIO, mesh: Mesh) -> None:
    """OBJ with the colour after the position, as MeshLab, Blender and Open3D read it."""
    file.write(b"# Specimap: millimetres, marker frame; v x y z red green blue\n")
    for rows in _blocks(len(mesh.vertices)):
        table = np.hstack([mesh.vertices[rows], mesh.colours[rows] / 255.0])
        file.write(_lines("v %.5f %.5f %.5f %.4f %.4f %.4f\n", table))
    for rows in _blocks(len(mesh.vertices)):
        file.write(_lines("vn %.4f %.4f %.4f\n", mesh.normals[rows]))
    for rows in _blocks(len(mesh.triangles)):
        file.write(_lines("f %d//%d %d//%d %d//%d\n", np.repeat(mesh.triangles[rows] + 1, 2, axis=1)))


def _write_glb(file: BinaryIO, mesh: Mesh) -> None:
    """Binary glTF 2.0. The vertices keep the marker frame's axes; the node above them turns z up to glTF's y."""
    metres = mesh.vertices * np.float32(_METRES)
    colours = np.full((len(metres), 4), 65535, "<u2")
    colours[:, :3] = _linear_colours(mesh.colours)
    parts = [
        (metres.astype("<f4"), 5126, "VEC3", 34962),
        (mesh.normals.astype("<f4"), 5126, "VEC3", 34962),
        (colours, 5123, "VEC4", 34962),
        (mesh.triangles.astype("<u4").ravel(), 5125, "SCALAR", 34963),
    ]
    views, accessors, at = [], [], 0
    for i, (values, component, kind, target) in enumerate(parts):
        views.append({"buffer": 0, "byteOffset": at, "byteLength": values.nbytes, "target": target})
        accessors.append({"bufferView": i, "componentType": component, "count": len(values), "type": kind})
        at += values.nbytes  # a multiple of 4 for each of them
    accessors[0] |= {"min": parts[0][0].min(0).tolist(), "max": parts[0][0].max(0).tolist()}
    accessors[2]["normalized"] = True
    half = 0.5**0.5
    document = {
        "asset": {"version": "2.0", "generator": "Specimap", "extras": {"frame": "marker", "unit": "m"}},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "specimen", "rotation": [-half, 0, 0, half]}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2}, "indices": 3, "material": 0}]}
        ],
        "materials": [{"pbrMetallicRoughness": {"metallicFactor": 0, "roughnessFactor": 1}, "doubleSided": True}],
        "buffers": [{"byteLength": at}],
        "bufferViews": views,
        "accessors": accessors,
    }
    text = json_text(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + at))
    file.write(struct.pack("<I4s", len(text), b"JSON") + text)
    file.write(struct.pack("<I4s", at, b"BIN\0"))
    for values, *_ in parts:
        file.write(values.tobytes())


MESH_WRITERS: dict[str, Callable[[BinaryIO, Mesh], None]] = {"stl": _write_stl, "obj": _write_obj, "glb": _write_glb}
"""Another format is one function here."""


def _linear_colours(colours: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """sRGB as linear light in 16 bits: glTF's vertex colours are linear, and 8 bits would lose the dark ones."""
    return np.asarray(np.rint(linear_from_srgb(colours) * 65535), np.uint16)


def _lines(line: str, table: Array) -> bytes:
    return "".join(line % tuple(row) for row in table.tolist()).encode("ascii")


def _blocks(rows: int) -> Iterator[slice]:
    for start in range(0, rows, _TOGETHER):
        yield slice(start, start + _TOGETHER)
