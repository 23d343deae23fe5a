"""An export's own process: makes one file of a result and ends. It needs neither database nor storage."""

from __future__ import annotations

import os
import resource
import sys
from pathlib import Path
from typing import TYPE_CHECKING, cast

from specimap_core.errors import SpecimapError
from specimap_core.sandbox.lifetime import die_with
from specimap_core.threads import limit_blas_threads

if TYPE_CHECKING:
    from specimap_core.export import ExportFormat

REFUSED = 2
"""Exit status where the error is on standard output, as a line of JSON."""


def make_export_file(cloud_folder: Path, format: str, target: Path) -> Path:
    """Write a result, a folder with ``cloud.zarr``, ``mesh.ply`` and ``report.json``, to ``target`` in a format of
    :class:`~specimap_core.export.formats.FileFormat`; whole or not at all.

    Raises:
        ValueError: there is no such format.
        SpecimapError: as the format's own writer.
    """
    # Imported late, since they load numpy.
    from specimap_core.cloud import Cloud
    from specimap_core.export import export_cloud
    from specimap_core.export.archive import write_envi_zip, write_zarr_zip
    from specimap_core.export.formats import FileFormat

    match FileFormat(format):
        case FileFormat.MESH_PLY | FileFormat.MESH_STL | FileFormat.MESH_OBJ | FileFormat.MESH_GLB as mesh:
            from specimap_core.surface.mesh_files import export_mesh, read_mesh_ply, write_mesh_ply

            if mesh is FileFormat.MESH_PLY:
                write_mesh_ply(target, read_mesh_ply(cloud_folder / "mesh.ply"))
                return target
            return export_mesh(cloud_folder / "mesh.ply", target, mesh.removeprefix("mesh-"))
        case FileFormat.ZARR:
            return write_zarr_zip(Cloud.open(cloud_folder / "cloud.zarr"), target)
        case FileFormat.DEIDENTIFIED | FileFormat.DEIDENTIFIED_INPUTS:
            from specimap_core.export.deidentified.archive import write_deidentified
            from specimap_core.export.deidentified.plan import Plan

            return write_deidentified(cloud_folder, Plan.read(cloud_folder), target)
        case FileFormat.ENVI:
            return write_envi_zip(Cloud.open(cloud_folder / "cloud.zarr"), target)
        case (
            FileFormat.PLY | FileFormat.LAS | FileFormat.NPZ | FileFormat.CSV | FileFormat.HTML | FileFormat.PDF
        ) as other:
            return export_cloud(Cloud.open(cloud_folder / "cloud.zarr"), target, cast("ExportFormat", other.value))


def main(arguments: list[str]) -> int:
    """Make one file. Arguments: folder, format, target, the parent's process id, most bytes of memory (0: no limit)."""
    limit_blas_threads()
    folder, format, target, parent, memory = arguments
    die_with(int(parent))
    if int(memory):
        resource.setrlimit(resource.RLIMIT_AS, (int(memory), int(memory)))
    # Libraries that print would spoil the answer.
    answer = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    try:
        make_export_file(Path(folder), format, Path(target))
    except SpecimapError as error:
        refused = error
    except MemoryError:
        refused = SpecimapError(
            "The export needs more memory than it may take.", advice="Raise SPECIMAP_STAGE_MEMORY_BYTES."
        )
    else:
        return 0
    from specimap_core.json_text import json_text

    with answer:
        answer.write(json_text(refused.as_dict()) + "\n")
    return REFUSED


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
