"""The list of formats, and the one way to open a cube."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from specimap_core.cube.calibrate import calibrated
from specimap_core.cube.envi import EnviFormat
from specimap_core.cube.hdf import HdfFormat
from specimap_core.cube.matlab5 import Matlab5Format
from specimap_core.cube.model import Cube, CubeFormat
from specimap_core.cube.netcdf3 import NetCdf3Format
from specimap_core.cube.npy import NpyFormat, NpzFormat
from specimap_core.cube.printable import printable
from specimap_core.cube.tiff import TiffFormat
from specimap_core.errors import CubeFormatError, CubeNotFoundError, CubeNotReadableError, SettingsError, SpecimapError

# The first that matches opens the file; ENVI, whose data files have no signature, comes last.
FORMATS: tuple[CubeFormat, ...] = (
    HdfFormat(),
    NetCdf3Format(),
    Matlab5Format(),
    NpyFormat(),
    NpzFormat(),
    TiffFormat(),
    EnviFormat(),
)


def open_cube(path: Path, *, white: Path | None = None, dark: Path | None = None) -> Cube:
    """The cube at ``path`` (for ENVI the header or the data file), calibrated if a white reference is given.

    Each path may end with ``::DATASET``, the name of one of several arrays in a file; a file whose own name holds
    ``::`` is taken as it is. Raises CubeNotFoundError, CubeNotReadableError, CubeFormatError, CubeHeaderError
    (``details['field']``), CubeTruncatedError, CubeContentError for references that do not fit, SettingsError for a
    dark reference without a white one.
    """
    if dark is not None and white is None:
        raise SettingsError(
            "A dark reference was given without a white one.",
            advice="Give both references, or none to keep raw counts.",
            setting="white",
        )
    raw, dataset = _open(Path(path))
    if white is None:
        return replace(raw, datasets=(dataset,))
    white_cube, white_dataset = _open(Path(white))
    dark_cube, dark_dataset = (None, None) if dark is None else _open(Path(dark))
    return replace(calibrated(raw, white_cube, dark_cube), datasets=(dataset, white_dataset, dark_dataset))


def split_dataset(path: Path) -> tuple[Path, str | None]:
    """File and data set of ``FILE::DATASET``; a path that exists as it stands is a file."""
    text = str(path)
    if "::" not in text or os.path.lexists(path):
        return path, None
    parts = text.split("::")
    for count in range(len(parts) - 1, 0, -1):
        file = Path("::".join(parts[:count]))
        if os.path.lexists(file) and not file.is_dir():
            return file, "::".join(parts[count:])
    return Path(parts[0]), "::".join(parts[1:])


def _open(given: Path) -> tuple[Cube, str | None]:
    path, dataset = split_dataset(given)
    try:
        _check_file(path)
        for cube_format in FORMATS:
            if cube_format.matches(path):
                return cube_format.open(path, dataset), dataset
    except SpecimapError:
        raise
    except PermissionError as error:  # from the file's own folder, or from the data next to a header
        raise _not_readable(Path(error.filename) if isinstance(error.filename, str) else path) from error
    except Exception as error:
        # Not a list of types: on damaged files the libraries raise anything, ZeroDivisionError included.
        raise CubeFormatError(
            f"{path.name} cannot be read: {printable(str(error), 300) or type(error).__name__}.",
            advice="The file is damaged, incomplete, or not what its name says: copy or export it again.",
            path=str(path),
        ) from error
    known = sorted({suffix for cube_format in FORMATS for suffix in cube_format.suffixes if suffix})
    raise CubeFormatError(
        f"{path.name} is of no known cube format.",
        advice="Give an ENVI header with its data, or a NumPy, HDF5, NetCDF, MATLAB or TIFF file.",
        path=str(path),
        suffixes=known,
    )


def _check_file(path: Path) -> None:
    """Refuse what needs no look at the content."""
    try:
        there = path.exists()
    except PermissionError:
        raise
    except OSError as error:
        raise CubeNotFoundError(
            f"{path} cannot be reached: {error.strerror}.", advice="Check the path and the disk.", path=str(path)
        ) from error
    if not there:
        lost = path.is_symlink()
        raise CubeNotFoundError(
            f"{path} {'is a link to a file that does not exist' if lost else 'does not exist'}.",
            advice="Check the path.",
            path=str(path),
        )
    if not path.is_file():
        what = "a folder" if path.is_dir() else "a device, pipe or socket"
        raise CubeFormatError(
            f"{path} is {what}, not a file.", advice="Give the cube's header or data file.", path=str(path)
        )
    with open(path, "rb") as file:
        if not file.read(1):
            raise CubeFormatError(f"{path.name} is empty.", advice="Copy or export the cube again.", path=str(path))


def _not_readable(path: Path) -> CubeNotReadableError:
    return CubeNotReadableError(
        f"{path} cannot be read: no permission.",
        advice="Give your user permission to read it and its folder, or copy the cube to a folder of your own.",
        path=str(path),
    )
