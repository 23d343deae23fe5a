"""A mesh as binary PLY, which every 3D program reads."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from specimap.core.files import atomic_path
from specimap.core.surface import Mesh


def write_mesh_ply(path: Path, mesh: Mesh) -> None:
    """Write vertices (mm, marker frame) with normals and colours, and triangles; little-endian, atomic."""
    vertex = np.dtype([("p", "<f4", 3), ("n", "<f4", 3), ("c", "u1", 3)])
    face = np.dtype([("count", "u1"), ("i", "<i4", 3)])
    vertices = np.empty(len(mesh.vertices), vertex)
    vertices["p"], vertices["n"], vertices["c"] = mesh.vertices, mesh.normals, mesh.colours
    faces = np.empty(len(mesh.triangles), face)
    faces["count"], faces["i"] = 3, mesh.triangles
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment millimetres, marker frame\n"
        f"element vertex {len(vertices)}\n"
        + "".join(f"property float {n}\n" for n in ("x", "y", "z", "nx", "ny", "nz"))
        + "".join(f"property uchar {n}\n" for n in ("red", "green", "blue"))
        + f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    with atomic_path(path) as aside, open(aside, "wb") as f:
        f.write(header.encode("ascii"))
        f.write(vertices.tobytes())
        f.write(faces.tobytes())
