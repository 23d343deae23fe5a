"""The list of formats, and the one way to open a cube."""

from __future__ import annotations

from pathlib import Path

from specimap.core.cube.calibrate import calibrated
from specimap.core.cube.envi import EnviFormat
from specimap.core.cube.hdf import HdfFormat
from specimap.core.cube.matlab5 import Matlab5Format
from specimap.core.cube.model import Cube, CubeFormat
from specimap.core.cube.netcdf3 import NetCdf3Format
from specimap.core.cube.npy import NpyFormat, NpzFormat
from specimap.core.cube.tiff import TiffFormat
from specimap.core.errors import CubeFormatError, CubeNotFoundError, SettingsError, SpecimapError

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

    Raises CubeNotFoundError, CubeFormatError, CubeHeaderError (``details['field']``), CubeTruncatedError,
    CubeContentError for references that do not fit, SettingsError for a dark reference without a white one.
    """
    if dark is not None and white is None:
        raise SettingsError(
            "A dark reference was given without a white one.",
            advice="Give both references, or none to keep raw counts.",
            setting="white",
        )
    raw = _open(Path(path))
    if white is None:
        return raw
    return calibrated(raw, _open(Path(white)), None if dark is None else _open(Path(dark)))


def _open(path: Path) -> Cube:
    if not path.exists():
        raise CubeNotFoundError(f"{path} does not exist.", advice="Check the path.", path=str(path))
    if not path.is_file():
        raise CubeFormatError(f"{path} is not a file.", advice="Give the cube's header or data file.", path=str(path))
    try:
        for cube_format in FORMATS:
            if cube_format.matches(path):
                return cube_format.open(path)
    except SpecimapError:
        raise
    except Exception as error:
        # Not a list of types: on damaged files the libraries raise anything, ZeroDivisionError included.
        raise CubeFormatError(
            f"{path.name} cannot be read: {error or type(error).__name__}.",
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
