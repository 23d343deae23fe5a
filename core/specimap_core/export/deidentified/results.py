"""A result without its history: arrays chunk by chunk, their documents written anew, mesh, pictures, figures."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from specimap_core.cloud.schema import ARRAYS
from specimap_core.errors import CloudDamagedError
from specimap_core.export.deidentified.photos import clean_picture
from specimap_core.export.deidentified.scrubbing import scrubbed
from specimap_core.json_text import json_text
from specimap_core.surface.mesh_files import read_mesh_ply, write_mesh_ply

GROUP: dict[str, Any] = {"zarr_format": 3, "node_type": "group"}
GROUP_ATTRIBUTES = ("specimap_version", "frame", "units", "bad_bands", "cube_shape")
ARRAY_ATTRIBUTES = ("scale_factor", "add_offset", "_FillValue", "quantity", "units")
ARRAY_MEMBERS = (
    *("zarr_format", "node_type", "shape", "data_type", "chunk_grid", "chunk_key_encoding", "fill_value", "codecs"),
    *("dimension_names", "storage_transformers"),
)
CHUNK = re.compile(r"c(/\d+)*")
DOCUMENTS = ("report.json", "cameras.json", "corners.json")


def clean_result(source: Path, target: Path, photos: Mapping[str, str]) -> None:
    """Write a result, a folder with ``cloud.zarr`` and the files next to it, into a new folder.

    ``photos``: new names of the photos. Label layers become ``label-001`` and so on, their classes ``class-<number>``.

    Raises:
        CloudDamagedError: a document of an array does not read.
    """
    cloud = target / "cloud.zarr"
    cloud.mkdir(parents=True)
    group = _read(source / "cloud.zarr" / "zarr.json")
    attributes = {key: group.get("attributes", {}).get(key) for key in GROUP_ATTRIBUTES}
    _write(cloud / "zarr.json", {**GROUP, "attributes": scrubbed(attributes, {})})
    for name in ARRAYS:
        _clean_array(source / "cloud.zarr" / name, cloud / name, ARRAY_ATTRIBUTES)
    _clean_labels(source / "cloud.zarr" / "labels", cloud / "labels")
    if (source / "mesh.ply").exists():
        write_mesh_ply(target / "mesh.ply", read_mesh_ply(source / "mesh.ply"))
    for name in ("preview.png", "photos.jpg"):
        if (source / name).exists():
            clean_picture(source / name, target / name)
    for name in DOCUMENTS:
        if (source / name).exists():
            _write(target / name, scrubbed(_read(source / name), photos))


def _clean_labels(source: Path, target: Path) -> None:
    layers = sorted(path.parent for path in source.glob("*/zarr.json"))
    if not layers:
        return
    target.mkdir()
    _write(target / "zarr.json", {**GROUP, "attributes": {}})
    for number, layer in enumerate(layers, 1):
        attributes = _read(layer / "zarr.json").get("attributes", {})
        kept: dict[str, Any] = {"classes": [], "version": 1}
        if attributes.get("kind") in ("class", "probability"):
            kept["kind"] = attributes["kind"]
        for found in attributes.get("classes") or []:
            value, colour = int(found["value"]), str(found.get("colour") or "")
            kept["classes"].append(
                {
                    "value": value,
                    "name": f"class-{value}",
                    "colour": colour if re.fullmatch(r"#[0-9a-fA-F]{6}", colour) else None,
                }
            )
        _clean_array(layer, target / f"label-{number:03d}", (), kept)


def _clean_array(source: Path, target: Path, kept: tuple[str, ...], more: Mapping[str, Any] | None = None) -> None:
    document = _read(source / "zarr.json")
    attributes = document.get("attributes", {})
    clean = {key: document[key] for key in ARRAY_MEMBERS if key in document}
    clean["attributes"] = {
        **scrubbed({key: attributes[key] for key in kept if key in attributes}, {}),
        **(more or {}),
    }
    target.mkdir()
    _write(target / "zarr.json", clean)
    for path in sorted(source.rglob("*")):
        name = path.relative_to(source).as_posix()
        if path.is_file() and CHUNK.fullmatch(name):
            place = target / name
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, place)


def _read(path: Path) -> dict[str, Any]:
    try:
        found: dict[str, Any] = json.loads(path.read_text("utf-8"))
        return found
    except (OSError, ValueError) as error:
        raise CloudDamagedError(
            f"{path.name} of the result does not read.", advice="Repeat the run; finished stages are not repeated."
        ) from error


def _write(path: Path, value: object) -> None:
    path.write_text(json_text(value, indent=1), encoding="utf-8")
