"""MATLAB 5 ``.mat`` files: the numeric arrays of one, those in structs and cells too, mapped or inflated.

Read here and not with scipy's loadmat, which crashes the process on some damaged files and always copies. Values keep
the type in which they are stored, which MATLAB may have narrowed when it saved.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from specimap_core.arrays import Array
from specimap_core.cube.declared_values import declared_of, is_word
from specimap_core.cube.discover import arrays_beside, choose_cube, choose_wavelengths, cube_axes
from specimap_core.cube.matlab5_elements import COMPRESSED, HEADER_BYTES, MATRIX, Inflated, Parser, Plain, StoredArray
from specimap_core.cube.model import Cube, describe
from specimap_core.cube.npy import starts_with
from specimap_core.cube.pixels import ArrayPixels
from specimap_core.cube.unpacked import bytes_of, scratch_array
from specimap_core.errors import CubeTruncatedError

_MAGIC = b"MATLAB 5.0 MAT-file"
_PIECE = 8 << 20


class Matlab5Format:
    """The numeric variable with three axes: rows x columns x bands, or as the wavelengths' length tells."""

    name = "MATLAB 5"
    suffixes: tuple[str, ...] = (".mat",)
    stored_suffix: str | None = ".mat"

    def matches(self, path: Path) -> bool:
        return starts_with(path, _MAGIC)

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        with open(path, "rb") as file:
            found = {stored.variable.name: stored for stored in _arrays(path, file)}
            variables = [stored.variable for stored in found.values()]
            cube, about_choice = choose_cube(path, variables, dataset)
            wavelengths = choose_wavelengths(variables, cube)
            array = _values(path, file, found[cube.name])
            values = None if wavelengths is None else _values(path, file, found[wavelengths.name])
            small = [v for v in arrays_beside(variables, cube) if is_word(v.short_name, v.shape)]
            stated = {v.short_name: _values(path, file, found[v.name]) for v in small}
        axes, about_axes = cube_axes(cube, wavelengths, reversed_axes=False)
        return describe(
            path,
            self.name,
            ArrayPixels(array.transpose(axes)),
            wavelengths=None if values is None else values.astype(np.float64).ravel(),
            units=wavelengths.units if wavelengths else None,
            declared=declared_of(path.name, stated, cube.name),
            # MATLAB's own order, rows x columns x bands, is no guess.
            warnings=about_choice + (() if wavelengths is None else about_axes),
        )


def _arrays(path: Path, file: BinaryIO) -> Iterator[StoredArray]:
    end = path.stat().st_size
    order = {b"IM": "<", b"MI": ">"}[file.read(HEADER_BYTES)[-2:]]
    start = HEADER_BYTES
    while start + 8 <= end:
        file.seek(start)
        kind, size = struct.unpack(order + "II", file.read(8))
        start += 8
        if start + size > end:
            raise CubeTruncatedError(
                f"{path.name} holds {end} bytes of at least {start + size}.",
                advice="Copy the cube again, completely.",
                expected_bytes=start + size,
                found_bytes=end,
            )
        if kind == MATRIX:
            yield from Parser(Plain(file), order, start, size, packed=False).arrays(size)
        elif kind == COMPRESSED:
            inflated = Inflated(file, size)
            kind, inner = struct.unpack(order + "II", inflated.read(8))
            if kind == MATRIX:
                yield from Parser(inflated, order, start, size, packed=True).arrays(inner)
        start += size


def _values(path: Path, file: BinaryIO, stored: StoredArray) -> Array:
    variable = stored.variable
    count = math.prod(variable.shape)
    if not stored.packed:
        offset = stored.start + stored.skip
        flat = np.asarray(np.memmap(path, variable.dtype, "r", offset=offset, shape=(count,)))
        return flat.reshape(variable.shape, order="F")
    out = scratch_array((count,), variable.dtype)
    target = bytes_of(out)
    file.seek(stored.start)
    inflated = Inflated(file, stored.size)
    inflated.skip(stored.skip)
    for at in range(0, len(target), _PIECE):
        target[at : at + _PIECE] = inflated.read(min(_PIECE, len(target) - at))
    return out.reshape(variable.shape, order="F")
