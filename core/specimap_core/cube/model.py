"""A hyperspectral cube: what it is, and its values by rows, by band and as a mean image."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.cube.declared_values import Declared
from specimap_core.cube.pixels import Pixels, read_bip, workers
from specimap_core.cube.values import Quantity, interpret
from specimap_core.cube.wavelengths import bad_band_mask, nanometres
from specimap_core.errors import CubeHeaderError
from specimap_core.notices import Notices

_HASH_CHUNK = 16 << 20


@dataclass(frozen=True, eq=False)
class Cube:
    """An open cube. Values stay on disk until they are asked for.

    Values are as the file means them: what it stands for no value is NaN, gains and offsets are applied; only a factor
    that is one for all bands is left to ``to_reflectance``, so that integers stay integers.

    ``wavelengths_nm`` (B,) is NaN where the file names none; ``bad_bands`` (B,). ``to_reflectance`` times a value is
    reflectance; None where the values are counts. ``saturation``: the value from which on a band counts as saturated,
    (), (B,) or (cols, B), NaN or None where that is unknown. ``exposure``: how long a line was exposed, in the file's
    own unit, None where it does not say. ``files`` are those
    whose content makes the cube, ``datasets`` what was asked for by name in them.
    """

    path: Path
    format_name: str
    pixels: Pixels = field(repr=False)
    files: tuple[Path, ...] = field(repr=False)
    wavelengths_nm: Floats = field(repr=False)
    bad_bands: NDArray[np.bool_] = field(repr=False)
    quantity: Quantity
    to_reflectance: float | None
    saturation: Floats | None = field(repr=False)
    warnings: Notices
    datasets: tuple[str | None, ...] = ()
    exposure: float | None = None

    @property
    def rows(self) -> int:
        """Rows (ENVI: lines)."""
        return self.pixels.shape[0]

    @property
    def cols(self) -> int:
        """Columns (ENVI: samples)."""
        return self.pixels.shape[1]

    @property
    def bands(self) -> int:
        """Bands."""
        return self.pixels.shape[2]

    @property
    def dtype(self) -> np.dtype:
        """Type of the values as read, in native byte order."""
        return self.pixels.dtype

    def read_rows(self, start: int, stop: int) -> Array:
        """Values (stop - start, cols, bands), C-contiguous, native byte order.

        May be a read-only view of the file. Raises IndexError outside ``0 <= start < stop <= rows``.
        """
        if not 0 <= start < stop <= self.rows:
            raise IndexError(f"rows {start}:{stop} of a cube with {self.rows} rows")
        return read_bip(self.pixels, start, stop)

    def band(self, index: int) -> Array:
        """Values of one band (rows, cols), native byte order."""
        if not 0 <= index < self.bands:
            raise IndexError(f"band {index} of a cube with {self.bands} bands")
        return self.pixels.band(index)

    def mean_image(self, bands: slice | NDArray[np.intp] | NDArray[np.bool_] | None = None) -> NDArray[np.float32]:
        """Mean (rows, cols) of the values over ``bands`` (default: all that are not bad), NaN left out.

        A pixel that is NaN in each of these bands is NaN. Raises ValueError when no band is chosen.
        """
        chosen = np.arange(self.bands)[~self.bad_bands if bands is None else bands]
        chosen = np.unique(chosen)
        if not chosen.size:
            raise ValueError("no band to average")
        return self.pixels.mean(chosen)

    def fingerprint(self) -> str:
        """Hash of the content of all the cube's files, whatever their names: 64 hexadecimal digits.

        SHA-256 of the SHA-256 digests of 16 MiB pieces, so that the cores share the work. Data sets chosen by name
        are part of it.
        """
        content = digest_files(self.files)
        if not any(self.datasets):
            return content
        return hashlib.sha256(repr((content, self.datasets)).encode()).hexdigest()


def digest_files(files: Sequence[Path]) -> str:
    """See :meth:`Cube.fingerprint`."""
    pieces = [(f, at) for f in files for at in range(0, max(1, f.stat().st_size), _HASH_CHUNK)]

    def digest(piece: tuple[Path, int]) -> bytes:
        path, at = piece
        with open(path, "rb") as file:
            file.seek(at)
            first = b"\1" if at == 0 else b"\0"  # marks where one file ends and the next begins
            return first + hashlib.sha256(file.read(_HASH_CHUNK)).digest()

    total = hashlib.sha256()
    with ThreadPoolExecutor(workers()) as pool:
        for part in pool.map(digest, pieces):
            total.update(part)
    return total.hexdigest()


class CubeFormat(Protocol):
    """A file format. Another one is one small class in the list of :mod:`specimap_core.cube.opening`, from which a run
    and the judging of uploads take it."""

    name: str
    suffixes: tuple[str, ...]
    stored_suffix: str | None
    """Of an uploaded file that is the whole cube and known by how it begins; None where it is told another way."""

    def matches(self, path: Path) -> bool:
        """Whether the file at ``path`` (it exists) is of this format; cheap, never raises for bad content."""

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        """The cube, of several in the file the one called ``dataset``.

        Raises a leaf of SpecimapError; what a library raises is wrapped by the caller.
        """


def describe(
    path: Path,
    format_name: str,
    pixels: Pixels,
    *,
    files: tuple[Path, ...] | None = None,
    wavelengths: Floats | None = None,
    units: str | None = None,
    bad_band_list: Floats | None = None,
    declared: Declared | None = None,
    warnings: Notices = (),
) -> Cube:
    """A cube from what a format found: units, bad bands and what values mean are settled here for all formats.

    Raises CubeHeaderError for gains or offsets that do not fit the bands.
    """
    wavelengths_nm, about_wavelengths = nanometres(wavelengths, units, pixels.shape[2])
    bad_bands, about_bands = bad_band_mask(bad_band_list, pixels.shape[2])
    values = interpret(path.name, pixels, bad_bands, declared or Declared())
    return Cube(
        path=path,
        format_name=format_name,
        pixels=values.pixels,
        files=files or (path,),
        wavelengths_nm=wavelengths_nm,
        bad_bands=bad_bands,
        quantity=values.quantity,
        to_reflectance=values.to_reflectance,
        saturation=values.saturation,
        warnings=warnings + about_wavelengths + about_bands + values.warnings,
        exposure=None if declared is None else declared.exposure,
    )


_READABLE = {"u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8", "f2", "f4", "f8"}


def readable_dtype(dtype: np.dtype) -> bool:
    """Whether a cube's values may be of this type: integers and real floats of 1 to 8 bytes."""
    return not dtype.hasobject and dtype.str[1:] in _READABLE


def check_dtype(path: Path, dtype: np.dtype) -> None:
    """Raises CubeHeaderError with the field ``dtype`` for complex, text, boolean and other values."""
    if not readable_dtype(dtype):
        raise CubeHeaderError(
            f"{path.name} holds values of type {dtype}.",
            advice="Save the cube as integers or real floating-point numbers.",
            field="dtype",
            value=str(dtype),
        )
