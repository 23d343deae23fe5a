"""PLY, binary little-endian: geometry, colour, position error and flags."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from specimap_core.atomic import atomic_path
from specimap_core.cloud import SHARD_POINTS, Cloud

_VERTEX = np.dtype(
    [
        *((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")),
        *((name, "u1") for name in ("red", "green", "blue")),
        ("sigma_mm", "<f4"),
        ("flags", "u1"),
    ]
)
_NAMES = {"<f4": "float", "|u1": "uchar"}


def write_ply(cloud: Cloud, target: Path) -> Path:
    """Write the points in the cloud's order, mm in the marker frame. Spectra stay in the cloud."""
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment Specimap: mm, marker frame; vertex n is point n of the cloud, which holds the spectra",
        f"element vertex {cloud.n_points}",
        *(f"property {_NAMES[_VERTEX[name].str]} {name}" for name in _VERTEX.names or ()),
        "end_header\n",
    ]
    with atomic_path(target) as aside, open(aside, "wb") as file:
        file.write("\n".join(header).encode("ascii"))
        for start in range(0, cloud.n_points, SHARD_POINTS):
            part = slice(start, start + SHARD_POINTS)
            vertices = np.empty(len(cloud.flags[part]), _VERTEX)
            for i, name in enumerate("xyz"):
                vertices[name] = cloud.xyz[part, i]
                vertices[f"n{name}"] = cloud.normal[part, i]
            for i, name in enumerate(("red", "green", "blue")):
                vertices[name] = cloud.rgb[part, i]
            vertices["sigma_mm"] = cloud.sigma_mm[part]
            vertices["flags"] = cloud.flags[part]
            file.write(vertices.data)
    return target
