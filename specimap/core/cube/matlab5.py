"""MATLAB 5 ``.mat`` files: the numeric arrays of one, mapped or inflated.

Read here and not with scipy's loadmat, which crashes the process on some damaged files and always copies.
Source: MathWorks, "MAT-File Format", level 5. Values keep the type in which they are stored, which MATLAB may have
narrowed when it saved.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from specimap.core.cube.declared import declared_of, is_word
from specimap.core.cube.discover import Variable, choose_cube, choose_wavelengths, cube_axes
from specimap.core.cube.model import Cube, describe
from specimap.core.cube.npy import starts_with
from specimap.core.cube.pixels import ArrayPixels
from specimap.core.cube.scratch import bytes_of, scratch_array
from specimap.core.errors import CubeTruncatedError
from specimap.core.geometry import Array

_MAGIC = b"MATLAB 5.0 MAT-file"
_HEADER_BYTES = 128
_MATRIX, _COMPRESSED = 14, 15
_NUMERIC_CLASSES = range(6, 16)
_STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_COMPLEX_FLAG = 0x08
_LONGEST_PART = 4096  # of dimensions or a name
_MOST_INFLATION = 1032  # zlib's own limit
_PIECE = 8 << 20

_Read = Callable[[int], bytes]


@dataclass(frozen=True)
class _Matrix:
    """A numeric array; its values begin ``skip`` bytes into the element at ``start`` (inflated, if packed)."""

    variable: Variable
    start: int
    size: int
    packed: bool
    skip: int


class Matlab5Format:
    """The numeric variable with three axes: rows x columns x bands, or as the wavelengths' length tells."""

    name = "MATLAB 5"
    suffixes: tuple[str, ...] = (".mat",)

    def matches(self, path: Path) -> bool:
        return starts_with(path, _MAGIC)

    def open(self, path: Path) -> Cube:
        with open(path, "rb") as file:
            found = {matrix.variable.name: matrix for matrix in _matrices(path, file)}
            variables = [matrix.variable for matrix in found.values()]
            cube = choose_cube(path, variables)
            wavelengths = choose_wavelengths(variables, cube)
            array = _values(path, file, found[cube.name])
            values = None if wavelengths is None else _values(path, file, found[wavelengths.name])
            said = {v.name: _values(path, file, found[v.name]) for v in variables if is_word(v.name, v.shape)}
        axes, warnings = cube_axes(cube, wavelengths, reversed_axes=False)
        return describe(
            path,
            self.name,
            ArrayPixels(array.transpose(axes)),
            wavelengths=None if values is None else values.astype(np.float64).ravel(),
            units=wavelengths.units if wavelengths else None,
            declared=declared_of(path.name, said, cube.name),
            # MATLAB's own order, rows x columns x bands, is no guess.
            warnings=() if wavelengths is None else warnings,
        )


def _matrices(path: Path, file: BinaryIO) -> Iterator[_Matrix]:
    end = path.stat().st_size
    order = {b"IM": "<", b"MI": ">"}[file.read(_HEADER_BYTES)[-2:]]
    start = _HEADER_BYTES
    while start + 8 <= end:
        file.seek(start)
        kind, size = struct.unpack(order + "II", file.read(8))
        if start + 8 + size > end:
            raise CubeTruncatedError(
                f"{path.name} holds {end} bytes of at least {start + 8 + size}.",
                advice="Copy the cube again, completely.",
                expected_bytes=start + 8 + size,
                found_bytes=end,
            )
        matrix: _Matrix | None = None
        if kind == _MATRIX:
            matrix = _matrix(file.read, order, start + 8, size, packed=False)
        elif kind == _COMPRESSED:
            inflated = _Inflated(file, size)
            kind, _ = struct.unpack(order + "II", inflated.read(8))
            if kind == _MATRIX:
                matrix = _matrix(inflated.read, order, start + 8, size, packed=True)
        if matrix is not None:
            yield matrix
        start += 8 + size


def _matrix(read: _Read, order: str, start: int, size: int, *, packed: bool) -> _Matrix | None:
    """The array whose parts ``read`` is about to give; None if it is not of real numbers."""
    skip = 8 if packed else 0
    flags, used = _part(read, order)
    skip += used
    (word,) = struct.unpack(order + "I", flags[:4])
    if word & 0xFF not in _NUMERIC_CLASSES or (word >> 8) & _COMPLEX_FLAG:
        return None
    sides, used = _part(read, order)
    skip += used
    shape = struct.unpack(f"{order}{len(sides) // 4}i", sides)
    name, used = _part(read, order)
    skip += used
    kind, length, small = _tag(read(8), order)
    dtype = np.dtype(_STORED_TYPES[kind]).newbyteorder("<" if order == "<" else ">")
    skip += 4 if small else 8
    room = size * _MOST_INFLATION if packed else size
    if min(shape) < 0 or math.prod(shape) * dtype.itemsize != length or skip + length > room:
        raise ValueError(f"the size of '{name.decode('latin-1')}' contradicts its shape {shape}")
    return _Matrix(Variable(name.decode("latin-1"), shape, dtype), start, size, packed, skip)


def _tag(raw: bytes, order: str) -> tuple[int, int, bool]:
    """Type and length of a part, and whether its value stands in the tag itself."""
    kind, length = struct.unpack(order + "II", raw)
    if kind >> 16:
        return kind & 0xFFFF, kind >> 16, True
    return kind, length, False


def _part(read: _Read, order: str) -> tuple[bytes, int]:
    """The content of a short part, and how many bytes it takes with its tag and padding."""
    raw = read(8)
    _, length, small = _tag(raw, order)
    if small:
        return raw[4 : 4 + length], 8
    if length > _LONGEST_PART:
        raise ValueError(f"a part of {length} bytes where a name or dimensions belong")
    padded = -(-length // 8) * 8
    return read(padded)[:length], 8 + padded


def _values(path: Path, file: BinaryIO, matrix: _Matrix) -> Array:
    variable = matrix.variable
    count = math.prod(variable.shape)
    if not matrix.packed:
        offset = matrix.start + matrix.skip
        flat = np.asarray(np.memmap(path, variable.dtype, "r", offset=offset, shape=(count,)))
        return flat.reshape(variable.shape, order="F")
    out = scratch_array((count,), variable.dtype)
    target = bytes_of(out)
    file.seek(matrix.start)
    inflated = _Inflated(file, matrix.size)
    inflated.read(matrix.skip)
    for at in range(0, len(target), _PIECE):
        target[at : at + _PIECE] = inflated.read(min(_PIECE, len(target) - at))
    return out.reshape(variable.shape, order="F")


class _Inflated:
    """Reads exactly as many inflated bytes as asked for, from ``size`` packed ones at the file's position."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size
        self._inflate = zlib.decompressobj()

    def read(self, count: int) -> bytes:
        """``count`` bytes. Raises ValueError where the packed data end before."""
        out = bytearray()
        while len(out) < count:
            packed = self._inflate.unconsumed_tail
            if not packed:
                packed = self._file.read(min(1 << 16, self._left))
                self._left -= len(packed)
            got = self._inflate.decompress(packed, count - len(out))
            if not got and (self._inflate.eof or not packed):
                raise ValueError("the packed data end early")
            out += got
        return bytes(out)
