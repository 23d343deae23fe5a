"""ENVI headers: text of ``field = value`` lines, read strictly where the data's layout depends on it.

Source: NV5 "ENVI Header Files" (field names, data type codes). Documented defaults for what instruments leave
out: ``byte order`` 0 (little endian), ``header offset`` 0, ``file type`` ENVI Standard, ``file compression``
0.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.cube.declared_values import WORDS, Declared, check_counts, declared_of, plain
from specimap_core.cube.printable import printable
from specimap_core.cube.spectral_units import read_unit
from specimap_core.errors import CubeHeaderError
from specimap_core.notices import Notice, Notices

MAGIC = "ENVI"
_LARGEST_HEADER = 32 << 20
_LARGEST_SIDE = 2**31 - 1
_LARGEST_CUBE_BYTES = 2**50
_WHOLE_NUMBER = re.compile(r"[+-]?[0-9]{1,18}")
_DATA_TYPES = {
    1: "u1",
    2: "i2",
    3: "i4",
    4: "f4",
    5: "f8",
    12: "u2",
    13: "u4",
    14: "i8",
    15: "u8",
}
_COMPLEX_TYPES = (6, 9)
# Kinds of file that carry an ENVI header, but no plain cube of spectra behind it.
_OTHER_FILE_TYPES = ("classification", "spectral library", "meta", "virtual", "tiff", "jpeg", "nitf", "hdf")
# Two lines of one of these that differ leave open what the data mean.
_UNIQUE_FIELDS = (
    "samples",
    "lines",
    "bands",
    "data type",
    "interleave",
    "byte order",
    "header offset",
    "file compression",
    "wavelength",
    "wavelength units",
    "bbl",
    "reflectance scale factor",
    "data ignore value",
    "data gain values",
    "data offset values",
)
# A byte-order mark, or the first letters of a header in UTF-16 without one.
_UTF16 = {
    b"\xff\xfe": "utf-16-le",
    b"\xfe\xff": "utf-16-be",
    b"E\0N\0": "utf-16-le",
    b"\0E\0N": "utf-16-be",
}


@dataclass(frozen=True)
class EnviHeader:
    """What a header says of the data behind it. ``dtype`` has the file's byte order."""

    rows: int
    cols: int
    bands: int
    dtype: np.dtype
    interleave: str
    offset: int
    compressed: bool
    wavelengths: Floats | None
    wavelength_units: str | None
    bad_band_list: Floats | None
    declared: Declared
    warnings: Notices

    @property
    def data_bytes(self) -> int:
        """Bytes that the data file must hold, header offset included."""
        return self.offset + self.rows * self.cols * self.bands * self.dtype.itemsize


def read_header(path: Path) -> EnviHeader:
    """The header at ``path``. Raises CubeHeaderError, whose ``details['field']`` names the culprit."""
    fields = parse_fields(path.name, _text(path))
    return _Reader(path.name, fields).header()


def is_envi_header(path: Path) -> bool:
    """Whether the file begins as an ENVI header does. Raises PermissionError where it may not be read."""
    try:
        with open(path, "rb") as f:
            return decoded(f.read(32)).lstrip().startswith(MAGIC)
    except PermissionError:
        raise
    except OSError:
        return False


def decoded(raw: bytes) -> str:
    """The text of a header, in UTF-16 or UTF-8 with or without a byte-order mark, or in Latin-1."""
    for start, encoding in _UTF16.items():
        if raw.startswith(start):
            return raw.decode(encoding, "replace").removeprefix("\ufeff")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def _text(path: Path) -> str:
    if path.stat().st_size > _LARGEST_HEADER:
        raise CubeHeaderError(
            f"{path.name} is too large for a header.",
            advice="Give the text header of the cube.",
            field="ENVI",
        )
    text = decoded(path.read_bytes())
    if not text.lstrip().startswith(MAGIC):
        raise CubeHeaderError(
            f"{path.name} is not an ENVI header: it does not begin with the word ENVI.",
            advice="Give the header that ENVI or the camera's software wrote beside the cube.",
            field="ENVI",
        )
    return text


def parse_fields(name: str, text: str) -> dict[str, str]:
    """Fields by lower-case name; values in braces without them. Lines that begin with ``;`` are comments."""
    fields: dict[str, str] = {}
    lines = iter(text.lstrip().splitlines()[1:])
    for line in lines:
        key, equals, value = line.partition("=")
        if not equals or line.lstrip().startswith(";"):
            continue
        key, value = " ".join(key.lower().split()), value.strip()
        if value.startswith("{"):
            parts = [value[1:]]
            while "}" not in parts[-1]:
                following = next(lines, None)
                if following is None:
                    raise CubeHeaderError(
                        f"{name}: the list of '{printable(key)}' is not closed; the header is cut short.",
                        advice="Copy the header again from where it was recorded.",
                        field=key,
                    )
                if not following.lstrip().startswith(";"):
                    parts.append(following)
            value = "\n".join(parts).rpartition("}")[0].strip()
        if key in _UNIQUE_FIELDS and key in fields and not _same(fields[key], value):
            raise CubeHeaderError(
                f"{name} gives '{key}' twice, as {printable(fields[key])!r} and {printable(value)!r}.",
                advice="Keep the right one of the two lines.",
                field=key,
            )
        fields[key] = value
    return fields


def _same(one: str, other: str) -> bool:
    """Whether two values differ in nothing but case, spaces and the way in which numbers are written."""

    def parts(value: str) -> list[str | float]:
        found: list[str | float] = []
        for word in re.split(r"[\s,]+", value.strip().lower()):
            try:
                found.append(float(word))
            except ValueError:
                found.append(word)
        return found

    return one == other or parts(one) == parts(other)


class _Reader:
    """Typed access to the fields; every refusal names its field."""

    def __init__(self, name: str, fields: Mapping[str, str]) -> None:
        self._name, self._fields = name, fields

    def header(self) -> EnviHeader:
        self._check_file_type()
        self._check_frames()
        cols, rows, bands = (self._whole(key, 1, _LARGEST_SIDE) for key in ("samples", "lines", "bands"))
        dtype = self._dtype()
        sides = {"samples": cols, "lines": rows, "bands": bands}
        if math.prod(sides.values()) * dtype.itemsize > _LARGEST_CUBE_BYTES:
            largest = max(sides, key=lambda key: sides[key])
            raise self._wrong(largest, "makes the cube larger than any disk")
        interleave = self._required("interleave").lower()
        if interleave not in ("bsq", "bil", "bip"):
            raise self._wrong("interleave", "is none of bsq, bil, bip")
        warnings: Notices = ()
        if "byte order" not in self._fields and dtype.itemsize > 1:
            text = "The header names no byte order; little endian is assumed."
            warnings = (Notice("byte_order_assumed", text),)
        return EnviHeader(
            rows,
            cols,
            bands,
            dtype=dtype.newbyteorder(">" if self._whole("byte order", 0, 1, default=0) else "<"),
            interleave=interleave,
            offset=self._whole("header offset", 0, _LARGEST_CUBE_BYTES, default=0),
            compressed=bool(self._whole("file compression", 0, 1, default=0)),
            wavelengths=self._numbers("wavelength"),
            wavelength_units=self._wavelength_units(),
            bad_band_list=self._numbers("bbl"),
            declared=self._declared(bands),
            warnings=warnings,
        )

    def _wrong(self, field: str, why: str) -> CubeHeaderError:
        value = self._fields.get(field, "")
        stated = printable(value)
        return CubeHeaderError(
            f"{self._name}: '{field} = {stated}' {why}.",
            advice=f"Correct '{field}' in the header, or export the cube again.",
            field=field,
            value=stated,
        )

    def _required(self, field: str) -> str:
        value = self._fields.get(field, "").partition(";")[0].strip()
        if not value:
            raise CubeHeaderError(
                f"{self._name} has no '{field}'.",
                advice=f"Add '{field}' to the header, or export the cube again.",
                field=field,
            )
        return value

    def _whole(self, field: str, low: int, high: int, *, default: int | None = None) -> int:
        if default is not None and field not in self._fields:
            return default
        value = self._required(field)
        if not _WHOLE_NUMBER.fullmatch(value):
            raise self._wrong(field, "is not a whole number of reasonable size")
        number = int(value)
        if not low <= number <= high:
            raise self._wrong(field, f"is not between {low} and {high}")
        return number

    def _dtype(self) -> np.dtype:
        code = self._whole("data type", 0, 1000)
        if code in _COMPLEX_TYPES:
            raise self._wrong("data type", "means complex numbers, which are not spectra")
        if code not in _DATA_TYPES:
            raise self._wrong("data type", "is no data type of ENVI")
        return np.dtype(_DATA_TYPES[code])

    def _check_file_type(self) -> None:
        kind = self._fields.get("file type", "").lower()
        if any(word in kind for word in _OTHER_FILE_TYPES):
            raise self._wrong("file type", "is not a plain cube of spectra")

    def _check_frames(self) -> None:
        """Values alone may stand in the data: bytes between lines or bands would be read as values."""
        for field in ("major frame offsets", "minor frame offsets"):
            found = self._numbers(field)
            if found is not None and found.any():
                raise self._wrong(field, "puts other bytes between the values, which is not read")

    def _numbers(self, field: str) -> Floats | None:
        text = self._fields.get(field)
        if text is None:
            return None
        words = [word for word in re.split(r"[\s,]+", text) if word]
        try:
            return np.array([float(word) for word in words], np.float64)
        except ValueError:
            raise self._wrong(field, "holds something that is not a number") from None

    def _wavelength_units(self) -> str | None:
        units = self._fields.get("wavelength units", "")
        # Spectrometers that leave the units out name them on the axis of the spectra's plot.
        axis = self._fields.get("z plot titles", "").partition(",")[0]
        if read_unit(units).kind == "none" and read_unit(axis).kind not in ("none", "index", "unrecognised"):
            return axis
        return units

    def _declared(self, bands: int) -> Declared:
        fields = {key: value.partition(";")[0] for key, value in self._fields.items() if plain(key) in WORDS}
        # Of a plot's titles the second is the values' own.
        title, description = self._fields.get("z plot titles", "").partition(",")[2], self._fields.get("description")
        declared = declared_of(self._name, fields, title, description=description)
        check_counts(self._name, declared, bands)
        return declared
