"""NumPy files. Nothing is ever unpickled: an array of objects is refused from its header."""

from __future__ import annotations

import math
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from specimap_core.arrays import Array, Floats
from specimap_core.cube.declared_values import declared_of, is_word
from specimap_core.cube.discover import Variable, arrays_beside, choose_cube, choose_wavelengths, cube_axes
from specimap_core.cube.model import Cube, check_dtype, describe
from specimap_core.cube.pixels import ArrayPixels
from specimap_core.cube.printable import printable
from specimap_core.cube.unpacked import bytes_of, scratch_array
from specimap_core.errors import CubeFormatError, CubeTruncatedError
from specimap_core.notices import Notice, Notices

_NPY_MAGIC = b"\x93NUMPY"
_ZIP_MAGIC = b"PK\x03\x04"
_LOCAL_HEADER_BYTES = 30
_PIECE = 8 << 20
_LONGEST_UNITS = 512


def starts_with(path: Path, magic: bytes) -> bool:
    """Whether the file begins with these bytes; False where it cannot be read."""
    try:
        with open(path, "rb") as f:
            return f.read(len(magic)) == magic
    except OSError:
        return False


def refuse_dataset(path: Path, dataset: str | None) -> None:
    """Raises CubeFormatError where one is named in a file that holds a single array."""
    if dataset is not None:
        raise CubeFormatError(
            f"{path.name} holds one cube, and no data sets with names such as '{printable(dataset)}'.",
            advice="Give the file alone, without '::'.",
        )


@dataclass(frozen=True)
class _NpyHeader:
    shape: tuple[int, ...]
    dtype: np.dtype
    fortran: bool
    header_bytes: int

    @property
    def data_bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    def shaped(self, flat: Array) -> Array:
        return flat.reshape(self.shape, order="F" if self.fortran else "C")


def _read_npy_header(stream: IO[bytes]) -> _NpyHeader:
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, fortran, dtype = read(stream)
    if not all(isinstance(side, int) and side >= 0 for side in shape):
        raise ValueError(f"impossible shape {shape}")
    return _NpyHeader(shape, dtype, fortran, stream.tell())


def _mapped(path: Path, header: _NpyHeader, offset: int) -> Array:
    expected = offset + header.data_bytes
    found = path.stat().st_size
    if found < expected:
        raise CubeTruncatedError(
            f"{path.name} holds {found} bytes, its header asks for {expected}.",
            advice="Copy the cube again, completely.",
            expected_bytes=expected,
            found_bytes=found,
        )
    count = math.prod(header.shape)
    return header.shaped(np.asarray(np.memmap(path, header.dtype, "r", offset=offset, shape=(count,))))


class NpyFormat:
    """``.npy``: an array (rows, cols, bands), mapped."""

    name = "NumPy"
    suffixes: tuple[str, ...] = (".npy",)
    stored_suffix: str | None = ".npy"

    def matches(self, path: Path) -> bool:
        return starts_with(path, _NPY_MAGIC)

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        refuse_dataset(path, dataset)
        with open(path, "rb") as stream:
            header = _read_npy_header(stream)
        check_dtype(path, header.dtype)
        if len(header.shape) != 3 or 0 in header.shape:
            raise CubeFormatError(
                f"{path.name} holds an array of shape {header.shape}, not a cube.",
                advice="Save an array of three axes: rows x columns x bands.",
                shape=list(header.shape),
            )
        warnings: Notices = ()
        if header.shape[0] == min(header.shape) < min(header.shape[1:]):
            rows, cols, bands = header.shape
            text = f"The array is taken as {rows} rows x {cols} columns x {bands} bands, as .npy has no names for axes."
            warnings = (Notice("axes_assumed", text),)
        return describe(path, self.name, ArrayPixels(_mapped(path, header, header.header_bytes)), warnings=warnings)


class NpzFormat:
    """``.npz``: the array ``cube`` (or the only one with three axes), and ``wavelengths``."""

    name = "NumPy archive"
    suffixes: tuple[str, ...] = (".npz",)
    stored_suffix: str | None = None

    def matches(self, path: Path) -> bool:
        return starts_with(path, _ZIP_MAGIC) and path.suffix.lower() in self.suffixes

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        with zipfile.ZipFile(path) as archive:
            headers = {}
            for info in archive.infolist():
                if info.filename.endswith(".npy"):
                    with archive.open(info) as stream:
                        headers[info.filename.removesuffix(".npy")] = _read_npy_header(stream)
            variables = [
                Variable(name, h.shape, h.dtype, text=_content(path, archive, name, headers))
                for name, h in headers.items()
            ]
            cube, about_choice = choose_cube(path, variables, dataset)
            wavelengths = choose_wavelengths(variables, cube)
            values: Floats | None = None
            if wavelengths is not None:
                values = np.array(_member(path, archive, wavelengths.name, headers), np.float64).ravel()
            array = _member(path, archive, cube.name, headers)
            small = [v for v in arrays_beside(variables, cube) if is_word(v.short_name, v.shape)]
            stated = {v.short_name: _member(path, archive, v.name, headers) for v in small}
        axes, about_axes = cube_axes(cube, wavelengths, reversed_axes=False)
        if values is None:  # an archive follows .npy: rows x columns x bands, where nothing speaks against it
            about_axes = ()
        return describe(
            path,
            self.name,
            ArrayPixels(array.transpose(axes)),
            wavelengths=values,
            units=wavelengths.units if wavelengths else None,
            declared=declared_of(path.name, stated, cube.name),
            warnings=about_choice + about_axes,
        )


def _content(path: Path, archive: zipfile.ZipFile, name: str, headers: dict[str, _NpyHeader]) -> str | None:
    """The text of a small array called units."""
    header = headers[name]
    if "unit" not in name.lower() or header.dtype.kind not in "US" or header.data_bytes > _LONGEST_UNITS:
        return None
    if math.prod(header.shape) != 1:
        return None
    value = _member(path, archive, name, headers).ravel()[0]
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _member(path: Path, archive: zipfile.ZipFile, name: str, headers: dict[str, _NpyHeader]) -> Array:
    """An array of the archive: mapped where it is stored as it is, else unpacked."""
    info, header = archive.getinfo(f"{name}.npy"), headers[name]
    expected = header.header_bytes + header.data_bytes
    if info.file_size != expected:
        raise CubeTruncatedError(
            f"{path.name}: '{name}' holds {info.file_size} bytes, its header asks for {expected}.",
            advice="Save the archive again.",
            expected_bytes=expected,
            found_bytes=info.file_size,
        )
    if info.compress_type == zipfile.ZIP_STORED:
        with open(path, "rb") as file:
            file.seek(info.header_offset)
            local = file.read(_LOCAL_HEADER_BYTES)
        lengths = int.from_bytes(local[26:28], "little") + int.from_bytes(local[28:30], "little")
        start = info.header_offset + _LOCAL_HEADER_BYTES + lengths
        return _mapped(path, header, start + header.header_bytes)
    out = scratch_array((math.prod(header.shape),), header.dtype)
    target = bytes_of(out)
    with archive.open(info) as stream:
        stream.read(header.header_bytes)
        filled = 0
        while filled < len(target):
            piece = stream.read(min(_PIECE, len(target) - filled))
            if not piece:
                raise ValueError(f"'{name}' ends early")
            target[filled : filled + len(piece)] = piece
            filled += len(piece)
    return header.shaped(out)
