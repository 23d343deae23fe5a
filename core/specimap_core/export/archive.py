"""Exports that are several files, as one ZIP: the cloud itself, and the ENVI pair."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable
from pathlib import Path
from shutil import copyfileobj
from tempfile import TemporaryDirectory

from specimap_core.atomic import atomic_path, disk_errors
from specimap_core.cloud import Cloud
from specimap_core.cloud.labels import GROUP_DOCUMENT
from specimap_core.export.envi import write_envi

_PIECE = 1024 * 1024
# The oldest date that ZIP knows: the same files make the same bytes.
_DATE = (1980, 1, 1, 0, 0, 0)


def write_zarr_zip(cloud: Cloud, target: Path) -> Path:
    """Write the cloud's files, labels too, stored as they are: zarr's ``ZipStore`` and xarray open the ZIP itself.

    Raises StorageFullError, OutputNotWritableError.
    """
    files = sorted(path for path in cloud.path.rglob("*") if path.is_file())
    extra = {"labels/zarr.json": GROUP_DOCUMENT} if cloud.label_names else {}
    named = ((path.relative_to(cloud.path).as_posix(), path) for path in files)
    return write_files_zip(
        target, ((name, path) for name, path in named if name not in extra), extra, zipfile.ZIP_STORED
    )


def write_envi_zip(cloud: Cloud, target: Path, *, grid_mm: float = 0.5) -> Path:
    """Write ``cloud.hdr`` and ``cloud.bil`` as :func:`write_envi` makes them, deflated.

    The pair stands next to ``target`` meanwhile. Raises SettingsError for the grid, StorageFullError,
    OutputNotWritableError, CloudDamagedError.
    """
    with disk_errors(target), TemporaryDirectory(prefix=".", suffix=".tmp", dir=target.parent) as folder:
        header = write_envi(cloud, Path(folder) / "cloud", grid_mm=grid_mm)
        pair = [header, header.with_suffix(".bil")]
        write_files_zip(target, ((path.name, path) for path in pair), {}, zipfile.ZIP_DEFLATED)
    return target


def write_files_zip(target: Path, files: Iterable[tuple[str, Path]], extra: dict[str, bytes], method: int) -> Path:
    """Write files and ``extra`` contents under their names; the same ones make the same bytes."""
    with atomic_path(target) as aside, zipfile.ZipFile(aside, "w", method) as archive:
        for name, data in extra.items():
            archive.writestr(_entry(name, method), data)
        for name, path in files:
            # The size is not known to the archive beforehand: it must be ready for more than 4 GiB.
            with open(path, "rb") as source, archive.open(_entry(name, method), "w", force_zip64=True) as member:
                copyfileobj(source, member, _PIECE)
    return target


def _entry(name: str, method: int) -> zipfile.ZipInfo:
    entry = zipfile.ZipInfo(name, _DATE)
    entry.compress_type = method
    entry.external_attr = 0o644 << 16
    return entry
