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

from specimap.core.cube.declared import WORDS, Declared, check_counts, declared_of, plain
from specimap.core.cube.wavelengths import Warnings
from specimap.core.errors import CubeHeaderError
from specimap.core.geometry import Floats

MAGIC = b"ENVI"
_LARGEST_HEADER = 32 << 20
_LARGEST_SIDE = 2**31 - 1
_LARGEST_CUBE_BYTES = 2**50
_WHOLE_NUMBER = re.compile(r"[+-]?[0-9]{1,18}")
_DATA_TYPES = {
    1: "u1", 2: "i2", 3: "i4", 4: "f4", 5: "f8", 12: "u2", 13: "u4", 14: "i8", 15: "u8",
}  # fmt: skip
_COMPLEX_TYPES = (6, 9)
# Kinds of file that carry an ENVI header, but no plain cube of spectra behind it.
_OTHER_FILE_TYPES = ("classification", "spectral library", "meta", "virtual", "tiff", "jpeg", "nitf", "hdf")
_LAYOUT_FIELDS = (
    "samples", "lines", "bands", "data type", "interleave", "byte order", "header offset", "file compression",
)  # fmt: skip


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
    warnings: Warnings

    @property
    def data_bytes(self) -> int:
        """Bytes that the data file must hold, header offset included."""
        return self.offset + self.rows * self.cols * self.bands * self.dtype.itemsize


def read_header(path: Path) -> EnviHeader:
    """The header at ``path``. Raises CubeHeaderError, whose ``details['field']`` names the culprit."""
    fields = parse_fields(path.name, _text(path))
    return _Reader(path.name, fields).header()


def is_envi_header(path: Path) -> bool:
    """Whether the file begins as an ENVI header does."""
    try:
        with open(path, "rb") as f:
            return f.read(16).removeprefix(b"\xef\xbb\xbf").lstrip().startswith(MAGIC)
    except OSError:
        return False


def _text(path: Path) -> str:
    if not is_envi_header(path):
        raise CubeHeaderError(
            f"{path.name} is not an ENVI header: it does not begin with the word ENVI.",
            advice="Give the header that ENVI or the camera's software wrote beside the cube.",
            field="ENVI",
        )
    if path.stat().st_size > _LARGEST_HEADER:
        raise CubeHeaderError(
            f"{path.name} is too large for a header.",
            advice="Give the text header of the cube.",
            field="ENVI",
        )
    raw = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("latin-1")


def parse_fields(name: str, text: str) -> dict[str, str]:
    """Fields by lower-case name; values in braces without them. Lines that begin with ``;`` are comments."""
    fields: dict[str, str] = {}
    lines = iter(text.splitlines()[1:])
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
                        f"{name}: the list of '{key}' is not closed; the header is cut short.",
                        advice="Copy the header again from where it was recorded.",
                        field=key,
                    )
                if not following.lstrip().startswith(";"):
                    parts.append(following)
            value = "\n".join(parts).rpartition("}")[0].strip()
        if key in _LAYOUT_FIELDS and fields.get(key, value) != value:
            raise CubeHeaderError(
                f"{name} gives '{key}' twice, as {fields[key]!r} and {value!r}.",
                advice="Keep the right one of the two lines.",
                field=key,
            )
        fields[key] = value
    return fields


class _Reader:
    """Typed access to the fields; every refusal names its field."""

    def __init__(self, name: str, fields: Mapping[str, str]) -> None:
        self._name, self._fields = name, fields

    def header(self) -> EnviHeader:
        self._check_file_type()
        cols, rows, bands = (self._whole(key, 1, _LARGEST_SIDE) for key in ("samples", "lines", "bands"))
        dtype = self._dtype()
        sides = {"samples": cols, "lines": rows, "bands": bands}
        if math.prod(sides.values()) * dtype.itemsize > _LARGEST_CUBE_BYTES:
            largest = max(sides, key=lambda key: sides[key])
            raise self._wrong(largest, "makes the cube larger than any disk")
        interleave = self._required("interleave").lower()
        if interleave not in ("bsq", "bil", "bip"):
            raise self._wrong("interleave", "is none of bsq, bil, bip")
        warnings: Warnings = ()
        if "byte order" not in self._fields and dtype.itemsize > 1:
            text = "The header names no byte order; little endian is assumed."
            warnings = (("byte_order_assumed", text),)
        return EnviHeader(
            rows, cols, bands,
            dtype=dtype.newbyteorder(">" if self._whole("byte order", 0, 1, default=0) else "<"),
            interleave=interleave,
            offset=self._whole("header offset", 0, _LARGEST_CUBE_BYTES, default=0),
            compressed=bool(self._whole("file compression", 0, 1, default=0)),
            wavelengths=self._numbers("wavelength"),
            wavelength_units=self._wavelength_units(),
            bad_band_list=self._numbers("bbl"),
            declared=self._declared(bands),
            warnings=warnings,
        )  # fmt: skip

    def _wrong(self, field: str, why: str) -> CubeHeaderError:
        value = self._fields.get(field, "")
        shown = value if len(value) <= 60 else value[:57] + "..."
        return CubeHeaderError(
            f"{self._name}: '{field} = {shown}' {why}.",
            advice=f"Correct '{field}' in the header, or export the cube again.",
            field=field, value=shown,
        )  # fmt: skip

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
        units = self._fields.get("wavelength units")
        # Spectrometers that leave the units out name them on the axis of the spectra's plot.
        return units if units is not None else self._fields.get("z plot titles", "").partition(",")[0]

    def _declared(self, bands: int) -> Declared:
        fields = {key: value.partition(";")[0] for key, value in self._fields.items() if plain(key) in WORDS}
        declared = declared_of(self._name, fields)
        check_counts(self._name, declared, bands)
        return declared
