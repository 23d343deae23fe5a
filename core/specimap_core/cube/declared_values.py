"""Read what a file declares of its values, in the words of any format."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.errors import CubeHeaderError
from specimap_core.notices import Notice, Notices

_NO_DATA = (
    "fillvalue",
    "missingvalue",
    "nodata",
    "nodatavalue",
    "dataignorevalue",
    "ignorevalue",
    "gdalnodata",
)
_CF_SCALE = "scale_factor"
_GAINS = ("scalefactor", "datagainvalues")
_OFFSETS = ("addoffset", "dataoffsetvalues")
_DIVISOR = "reflectancescalefactor"
# ENVI's words for what makes reflectance; the plain ones next to them make radiance.
_REFLECTANCE_GAINS = ("datareflectancegainvalues",)
_REFLECTANCE_OFFSETS = ("datareflectanceoffsetvalues",)
_CEILING = ("ceiling", "saturationlevel", "saturationvalue")
_BITS = "bitdepth"
_VALID = ("validmin", "validmax", "validrange")
_UNSIGNED = "unsigned"
_EXPOSURE = ("tint", "integrationtime", "exposuretime", "exposure")
WORDS = frozenset(
    (
        *_NO_DATA,
        *_GAINS,
        *_OFFSETS,
        *_REFLECTANCE_GAINS,
        *_REFLECTANCE_OFFSETS,
        _DIVISOR,
        *_CEILING,
        _BITS,
        *_VALID,
        *_EXPOSURE,
    )
)
"""What the names of attributes and variables are compared with, see :func:`plain`."""
# What other quantities are called, or their units, in which values may lie between 0 and 1 as well.
_OTHER_QUANTITY = re.compile(
    r"(?P<name>(ir)?radiance|absorbance|absorption|transmittance|transmission|emissivity|fluorescence)|"
    r"[\s/*(.]sr\b|\bsr\^?-1|\b[mu\u00b5]?w[\s/*.]*\(?c?m\^?-?2",
    re.IGNORECASE,
)
_NOTHING = ("", "none", "null", "na", "n/a")
_LONGEST = 100_000
_LEADING_NUMBER = re.compile(r"\s*[0-9]*\.?[0-9]+(e[+-]?[0-9]+)?(?=\s*[a-zµ]*\s*$)", re.IGNORECASE)
_SEPARATORS = re.compile(r"[\s,{}\[\]()]+")


@dataclass(frozen=True, eq=False)
class Declared:
    """What a file says of its values.

    ``no_data``: stored values that stand for none, besides NaN. ``valid``: stored values outside of these two are
    none. ``gains``, ``offsets`` (1,) or (B,): stored * gain + offset is the value; ``divisor``: the value by it is
    reflectance. ``names`` of the fields that gave them, for messages. ``ceiling``: the stored value at which the
    sensor clips. ``unsigned``: integers are to be read without sign. ``reflectance``: the file calls its values so.
    ``other``: what it calls them instead, such as radiance. ``exposure``: of a line, in the file's own unit.
    """

    no_data: tuple[float, ...] = ()
    valid: tuple[float, float] | None = None
    gains: Floats | None = None
    offsets: Floats | None = None
    divisor: float | None = None
    ceiling: float | None = None
    unsigned: bool = False
    reflectance: bool = False
    other: str | None = None
    exposure: float | None = None
    names: Mapping[str, str] | None = None
    warnings: Notices = ()

    def name(self, what: str) -> str:
        """The file's own word for ``gains``, ``offsets``, ``divisor``."""
        return (self.names or {}).get(what, what)


def plain(name: str) -> str:
    """A name without case, spaces, hyphens and underscores."""
    return re.sub(r"[\s_\-]", "", name).lower()


def declared_of(
    file_name: str, attributes: Mapping[str, object], *titles: str | None, description: str | None = None
) -> Declared:
    """What the attributes of a data set, the fields of a header, or small variables next to an array declare.

    ``scale_factor`` and ``add_offset`` are CF's: stored * scale_factor + add_offset. Spelt otherwise
    (``Scale_Factor``, as NEON does), or of a data set that calls itself reflectance, a factor of more than 1 is
    what values are divided by. ``titles``: names and units that may call the values reflectance, or something else.
    ``description``: free text, which is believed only where it speaks of something else and not of reflectance.

    Raises CubeHeaderError, whose ``details['field']`` names the attribute, for what is not a number, not finite, or
    a factor of zero.
    """
    found = {plain(name): (name, value) for name, value in attributes.items()}
    named = any("reflect" in (title or "").lower() for title in titles)
    other = None if named else _other_quantity(titles, description)
    reader = _Reader(file_name, found)
    names: dict[str, str] = {}
    scale = reader.first(_REFLECTANCE_GAINS, names, "gains")
    if scale is not None:
        named, other = True, None
        offsets = reader.first(_REFLECTANCE_OFFSETS, names, "offsets")
    else:
        scale, offsets = reader.first(_GAINS, names, "gains"), reader.first(_OFFSETS, names, "offsets")
    divisor = reader.first((_DIVISOR,), names, "divisor")
    _check_factor(file_name, names.get("divisor"), divisor, positive=True)
    _check_factor(file_name, names.get("gains"), scale, positive=False)
    warnings: Notices = ()
    if scale is not None and _divides(names["gains"], scale, named=named and offsets is None):
        text = f"'{names['gains']} = {scale[0]:g}' is taken for what values are divided by"
        if offsets is not None or divisor is not None:
            other = names.get("offsets") or names["divisor"]
            warnings = (Notice("scale_assumed", f"{text}, though '{other}' is there too."),)
            scale = 1 / scale
        else:
            if names["gains"] == _CF_SCALE:
                warnings = (Notice("scale_assumed", f"{text}: as a factor it would make no reflectance."),)
            names["divisor"], divisor, scale = names.pop("gains"), scale, None
    return Declared(
        no_data=reader.no_data(),
        valid=reader.valid(),
        gains=scale,
        offsets=offsets,
        divisor=None if divisor is None else float(divisor[0]),
        ceiling=reader.ceiling(),
        unsigned=_UNSIGNED in found and str(_text(found[_UNSIGNED][1])).lower() == "true",
        reflectance=named or divisor is not None,
        other=other,
        exposure=reader.exposure(),
        names=names,
        warnings=warnings,
    )


def _other_quantity(titles: Sequence[str | None], description: str | None) -> str | None:
    """What names or units call the values, where that is not reflectance; None where they state nothing."""
    for title in titles:
        if (found := _OTHER_QUANTITY.search(title or "")) is not None:
            return (found["name"] or "radiance").lower()
    if description and "reflect" not in description.lower():
        # A unit in free text may be of anything.
        return next((m["name"].lower() for m in _OTHER_QUANTITY.finditer(description) if m["name"]), None)
    return None


def is_word(name: str, shape: tuple[int, ...]) -> bool:
    """Whether a small variable next to an array, by its name and shape, declares something of the array's values."""
    size = math.prod(shape)
    return plain(name) in WORDS and size == max(shape, default=1) and 0 < size <= _LONGEST


def check_counts(file_name: str, declared: Declared, bands: int) -> None:
    """Raises CubeHeaderError, with the field, where gains or offsets are neither one nor one a band."""
    for what, numbers in (("gains", declared.gains), ("offsets", declared.offsets)):
        if numbers is not None and numbers.size not in (1, bands):
            field = declared.name(what)
            raise CubeHeaderError(
                f"{file_name}: '{field}' holds {numbers.size} numbers; the cube has {bands} bands.",
                advice=f"Give one number for each band in '{field}', or export the cube again.",
                field=field,
                value=str(numbers.size),
            )


def _divides(name: str, scale: Floats, *, named: bool) -> bool:
    """Whether a scale is what values are divided by; ``named``: the values call themselves reflectance."""
    return plain(name) == plain(_CF_SCALE) and scale.size == 1 and scale[0] > 1 and (name != _CF_SCALE or named)


def _check_factor(file_name: str, field: str | None, factor: Floats | None, *, positive: bool) -> None:
    if field is None or factor is None:
        return
    if positive and not (factor.size == 1 and factor[0] > 0):
        raise _wrong(file_name, field, factor, "is not a positive number")
    if (factor == 0).any():
        raise _wrong(file_name, field, factor, "is zero")


def _wrong(file_name: str, field: str, value: object, why: str) -> CubeHeaderError:
    shown = " ".join(str(_text(value)).split())
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    return CubeHeaderError(
        f"{file_name}: '{field} = {shown}' {why}.",
        advice=f"Correct '{field}', or export the cube again.",
        field=field,
        value=shown,
    )


def _text(value: object) -> object:
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.ravel()[0]
    return value.decode("utf-8", "replace").strip("\0 ") if isinstance(value, bytes) else value


class _Reader:
    """The attributes by plain name, as (own name, value)."""

    def __init__(self, file_name: str, found: Mapping[str, tuple[str, object]]) -> None:
        self._file, self._found = file_name, found

    def numbers(self, key: str) -> Floats | None:
        """Numbers (n,) of an attribute; None where it is absent or says that there are none."""
        if key not in self._found:
            return None
        name, value = self._found[key]
        value = _text(value)
        if isinstance(value, str):
            if value.strip().strip("{}").strip().lower() in _NOTHING:
                return None
            words = [word for word in _SEPARATORS.split(value) if word]
            try:
                return np.array([float(word) for word in words], np.float64)
            except ValueError:
                raise _wrong(self._file, name, value, "holds something that is not a number") from None
        try:
            array = np.asarray(value)
            if array.dtype.kind not in "iufb":
                raise TypeError
            numbers = array.astype(np.float64).ravel()
        except (TypeError, ValueError):
            raise _wrong(self._file, name, value, "is not a number") from None
        return numbers if numbers.size else None

    def first(self, keys: tuple[str, ...], names: dict[str, str], what: str) -> Floats | None:
        """Finite numbers of the first attribute that is there; its own name goes to ``names``."""
        for key in keys:
            numbers = self.numbers(key)
            if numbers is not None:
                names[what] = self._found[key][0]
                if not np.isfinite(numbers).all():
                    raise _wrong(self._file, names[what], self._found[key][1], "is not finite")
                return numbers
        return None

    def no_data(self) -> tuple[float, ...]:
        values: list[float] = []
        for key in _NO_DATA:
            numbers = self.numbers(key)
            values += [] if numbers is None else [float(n) for n in numbers]
        return tuple(dict.fromkeys(value for value in values if not np.isnan(value)))

    def valid(self) -> tuple[float, float] | None:
        low, high, both = (self.numbers(key) for key in _VALID)
        if both is not None and both.size == 2:
            return float(both.min()), float(both.max())
        if low is None and high is None:
            return None
        return (-np.inf if low is None else float(low[0]), np.inf if high is None else float(high[0]))

    def exposure(self) -> float | None:
        """Of several words the first that is one positive number, which may carry its unit (``10 ms``)."""
        for key in _EXPOSURE:
            found = _LEADING_NUMBER.match(str(_text(self._found[key][1]))) if key in self._found else None
            if found is not None and np.isfinite(value := float(found[0])) and value > 0:
                return value
        return None

    def ceiling(self) -> float | None:
        for key in _CEILING:
            numbers = self.numbers(key)
            if numbers is not None and numbers.size == 1 and numbers[0] > 0:
                return float(numbers[0])
        bits = self.numbers(_BITS)
        if bits is not None and bits.size == 1 and 4 <= bits[0] <= 32:
            return float(2 ** int(bits[0]) - 1)
        return None
