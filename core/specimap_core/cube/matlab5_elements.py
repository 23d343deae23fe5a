"""The elements of a MATLAB 5 file: which arrays of real numbers it holds, and where their values begin.

Source: MathWorks, "MAT-File Format", level 5. Structs, objects and cells are entered; what stands in them is named
after them, as ``scan/cube`` or ``list/2``. Every size that the file states is checked against what there is.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, Protocol

import numpy as np

from specimap_core.cube.discover import Variable

HEADER_BYTES = 128
MATRIX, COMPRESSED = 14, 15
_CELL, _STRUCT, _OBJECT, _CHAR = 1, 2, 3, 4
_NUMERIC_CLASSES = range(6, 16)
_STORED_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
_TEXT_TYPES = {1: "utf-8", 2: "utf-8", 4: "utf-16", 16: "utf-8", 17: "utf-16"}
_COMPLEX_FLAG = 0x08
_LONGEST_PART = 4096  # of dimensions or a name
_LONGEST_FIELD_NAMES = 1 << 20
_LONGEST_UNITS = 128
_MOST_INFLATION = 1032  # zlib's own limit
_PIECE = 1 << 20
_DEEPEST = 16
_MOST_ARRAYS = 100_000


@dataclass(frozen=True)
class StoredArray:
    """An array whose values begin ``skip`` bytes into the element of ``size`` bytes at ``start``.

    ``skip`` counts inflated bytes where the element is packed.
    """

    variable: Variable
    start: int
    size: int
    packed: bool
    skip: int


class Source(Protocol):
    """Bytes of an element in their order; ``position`` counts from its beginning."""

    position: int

    def read(self, count: int) -> bytes:
        """Exactly ``count`` bytes. Raises ValueError where there are fewer."""

    def skip(self, count: int) -> None:
        """Pass over ``count`` bytes."""


class Plain:
    """An element that is stored as it is, from the file's position on."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.position = file, 0

    def read(self, count: int) -> bytes:
        """See Source."""
        got = self._file.read(count)
        if len(got) < count:
            raise ValueError("the file ends inside an array")
        self.position += count
        return got

    def skip(self, count: int) -> None:
        """See Source."""
        self._file.seek(count, 1)
        self.position += count


class Inflated:
    """An element that is inflated from ``size`` packed bytes at the file's position."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._left = file, size
        self._inflate = zlib.decompressobj()
        self.position = 0

    def read(self, count: int) -> bytes:
        """See Source."""
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
        self.position += count
        return bytes(out)

    def skip(self, count: int) -> None:
        """See Source."""
        for at in range(0, count, _PIECE):
            self.read(min(_PIECE, count - at))


class Parser:
    """The arrays of one element of the file, which takes ``size`` bytes at ``start``."""

    def __init__(self, source: Source, order: str, start: int, size: int, *, packed: bool) -> None:
        self._source, self._order = source, order
        self._start, self._size, self._packed = start, size, packed
        self._room = size * _MOST_INFLATION if packed else size
        self._left = _MOST_ARRAYS

    def arrays(self, size: int, name: str | None = None, depth: int = 0) -> Iterator[StoredArray]:
        """Those in the matrix whose ``size`` bytes come next; ``name`` is that of a member, which has none itself."""
        end = self._source.position + size
        self._left -= 1
        if depth > _DEEPEST or self._left < 0:
            raise ValueError("structs or cells are nested too deep, or too many")
        if end > self._room:
            raise ValueError("an array is larger than the file")
        if size:
            yield from self._content(end, name, depth)
        if self._source.position > end:
            raise ValueError("an array reaches beyond what holds it")
        if depth:  # what follows in an outermost array need not be inflated
            self._source.skip(end - self._source.position)

    def _content(self, end: int, name: str | None, depth: int) -> Iterator[StoredArray]:
        (word,) = struct.unpack(self._order + "I", self._part()[:4])
        sides = self._part()
        shape = struct.unpack(f"{self._order}{len(sides) // 4}i", sides)
        own = self._part().decode("latin-1")
        name = own if name is None else name
        kind = word & 0xFF
        if min(shape, default=-1) < 0:
            raise ValueError(f"'{name}' has the impossible shape {shape}")
        if kind in (_CELL, _STRUCT, _OBJECT):
            yield from self._members(kind, math.prod(shape), name, end, depth)
        elif kind == _CHAR:
            text = self._text(name)
            if text is not None:
                yield self._stored(Variable(name, shape, np.dtype("U1"), text=text), 0)
        elif kind in _NUMERIC_CLASSES and not (word >> 8) & _COMPLEX_FLAG:
            stored, length, short = self._tag()
            skip = self._source.position - (4 if short is not None else 0)
            dtype = np.dtype(_STORED_TYPES[stored]).newbyteorder("<" if self._order == "<" else ">")
            if math.prod(shape) * dtype.itemsize != length or skip + length > min(self._room, end):
                raise ValueError(f"the size of '{name}' contradicts its shape {shape}")
            yield self._stored(Variable(name, shape, dtype), skip)

    def _stored(self, variable: Variable, skip: int) -> StoredArray:
        return StoredArray(variable, self._start, self._size, self._packed, skip)

    def _members(self, kind: int, count: int, name: str, end: int, depth: int) -> Iterator[StoredArray]:
        fields = [""]
        if kind != _CELL:
            if kind == _OBJECT:
                self._part()  # the name of its class
            (longest,) = struct.unpack(self._order + "i", self._part()[:4])
            names = self._part(_LONGEST_FIELD_NAMES)
            if longest < 1 or len(names) % longest:
                raise ValueError(f"the names of the fields of '{name}' have an impossible length")
            cut = (names[at : at + longest] for at in range(0, len(names), longest))
            fields = [field.partition(b"\0")[0].decode("latin-1") for field in cut]
        if count * len(fields) * 8 > end - self._source.position:
            raise ValueError(f"'{name}' is too small for all its members")
        for index in range(1, count + 1):
            base = f"{name}({index})" if kind != _CELL and count > 1 else name
            for field in fields:
                stored, size, short = self._tag()
                if stored != MATRIX or short is not None:
                    raise ValueError(f"'{name}' holds something that is no array")
                yield from self.arrays(size, f"{base}/{field or index}", depth + 1)

    def _text(self, name: str) -> str | None:
        """The characters of a short text called units."""
        stored, length, short = self._tag()
        if "unit" not in name.rpartition("/")[2].lower() or not 0 < length <= _LONGEST_UNITS:
            return None
        raw = self._source.read(length) if short is None else short
        encoding = _TEXT_TYPES.get(stored)
        if encoding == "utf-16":
            encoding += "-le" if self._order == "<" else "-be"
        return None if encoding is None else raw.decode(encoding, "replace")

    def _tag(self) -> tuple[int, int, bytes | None]:
        """Type and length of a part, and its value where that stands in the tag itself."""
        raw = self._source.read(8)
        kind, length = struct.unpack(self._order + "II", raw)
        if kind >> 16:
            return kind & 0xFFFF, kind >> 16, raw[4 : 4 + min(4, kind >> 16)]
        return kind, length, None

    def _part(self, longest: int = _LONGEST_PART) -> bytes:
        """The content of a short part."""
        _, length, short = self._tag()
        if short is not None:
            return short
        if length > longest:
            raise ValueError(f"a part of {length} bytes where a name or dimensions belong")
        return self._source.read(-(-length // 8) * 8)[:length]
