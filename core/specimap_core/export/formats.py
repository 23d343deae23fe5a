"""The file formats that a result is exported to."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class FileFormat(StrEnum):
    """A format of a single file; ``mesh-ply`` is there with every result, ``html`` and ``pdf`` are the report on it.

    ``deidentified`` is the result under pseudonyms, ``deidentified-inputs`` with photos and cube.
    """

    MESH_PLY = "mesh-ply"
    MESH_STL = "mesh-stl"
    MESH_OBJ = "mesh-obj"
    MESH_GLB = "mesh-glb"
    PLY = "ply"
    LAS = "las"
    NPZ = "npz"
    ENVI = "envi"
    ZARR = "zarr"
    CSV = "csv"
    HTML = "html"
    PDF = "pdf"
    DEIDENTIFIED = "deidentified"
    DEIDENTIFIED_INPUTS = "deidentified-inputs"


DEIDENTIFIED = frozenset({FileFormat.DEIDENTIFIED, FileFormat.DEIDENTIFIED_INPUTS})
WITH_LABELS = frozenset({FileFormat.ZARR, *DEIDENTIFIED})
"""Formats that hold the label layers: they are made again once these have changed."""


@dataclass(frozen=True)
class FileKind:
    """How a file is named and served."""

    suffix: str
    media_type: str


KINDS: dict[FileFormat, FileKind] = {
    FileFormat.MESH_PLY: FileKind("mesh.ply", "application/octet-stream"),
    FileFormat.MESH_STL: FileKind("mesh.stl", "model/stl"),
    FileFormat.MESH_OBJ: FileKind("mesh.obj", "model/obj"),
    FileFormat.MESH_GLB: FileKind("mesh.glb", "model/gltf-binary"),
    FileFormat.PLY: FileKind("ply", "application/octet-stream"),
    FileFormat.LAS: FileKind("las", "application/vnd.las"),
    FileFormat.NPZ: FileKind("npz", "application/zip"),
    FileFormat.ENVI: FileKind("envi.zip", "application/zip"),
    FileFormat.ZARR: FileKind("zarr.zip", "application/zip"),
    FileFormat.CSV: FileKind("csv", "text/csv"),
    FileFormat.HTML: FileKind("report.html", "text/html"),
    FileFormat.PDF: FileKind("report.pdf", "application/pdf"),
    FileFormat.DEIDENTIFIED: FileKind("deidentified.zip", "application/zip"),
    FileFormat.DEIDENTIFIED_INPUTS: FileKind("deidentified-inputs.zip", "application/zip"),
}


def file_name(cloud_id: str, format: FileFormat) -> str:
    """``cloud_01k….mesh.glb``: made of the id alone, so that it tells nothing about a patient."""
    return f"{cloud_id}.{KINDS[format].suffix}"
