"""Interpret the values of a cube, for all formats: no-data, gains, reflectance, where the sensor clips.

A file's own statements come first; a sample of rows then shows where they are missing, contradict each other, or make
no sense. What has no value is NaN from here on, for markers, references, clouds and pictures alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.cube.declared_values import Declared, check_counts
from specimap_core.cube.outliers import bounds, clip_level, dead_elements, undeclared_no_data
from specimap_core.cube.pixels import Pixels, sampled_rows
from specimap_core.cube.scaled_pixels import Missing, ScaledPixels, as_unsigned
from specimap_core.cube.strided import to_bip
from specimap_core.notices import Notice, Notices

Quantity = Literal["reflectance", "counts"]
QUANTITY_OTHER = "quantity_not_reflectance"

# Reflectance of wet tissue and of references lies in 0 to 1; noise and glints reach a little beyond.
_REFLECTANCE_RANGE = (-0.1, 2.0)
# White paper around the markers reflects far more.
_LEAST_BRIGHT = 0.02
_MOST_PERCENT = 200.0
_SAMPLED_ROWS = 16
_SAMPLED_VALUES = 6_000_000
_PERCENTILE_VALUES = 400_000


@dataclass(frozen=True, eq=False)
class InterpretedValues:
    """Pixels as they are to be read, and what their values are; see :class:`~specimap_core.cube.model.Cube`."""

    pixels: Pixels
    quantity: Quantity
    to_reflectance: float | None
    saturation: Floats | None
    warnings: Notices


def interpret(file_name: str, stored: Pixels, bad_bands: NDArray[np.bool_], declared: Declared) -> InterpretedValues:
    """Interpret the stored values. Raises CubeHeaderError for gains or offsets that do not fit the bands."""
    bands = stored.shape[2]
    check_counts(file_name, declared, bands)
    gains = _per_band(declared.gains, bands, idle=1.0)
    offsets = _per_band(declared.offsets, bands, idle=0.0)
    unsigned = declared.unsigned and stored.dtype.kind == "i"
    dtype = np.dtype(stored.dtype.str.replace("i", "u")) if unsigned else stored.dtype
    raw = sampled(stored)
    raw = as_unsigned(raw) if unsigned else raw
    missing, values, about_missing = _missing(raw, dtype, declared)
    good = ~bad_bands
    values = values[..., good]
    level = clip_level(_thinned(values), dtype, None if declared.divisor else declared.ceiling)
    converted = _thinned(values, by_pixel=True)
    if gains is not None or offsets is not None:
        converted = converted * (1.0 if gains is None else gains[good]) + (0.0 if offsets is None else offsets[good])
    real = dtype.kind == "f" or gains is not None or offsets is not None
    to_reflectance, about_scale = _to_reflectance(converted, declared, real=real)
    warnings = declared.warnings + about_missing + about_scale
    if to_reflectance is not None:
        warnings += implausible(converted * to_reflectance)
    elif real and declared.reflectance:
        warnings += _percent_warning(converted)
    # One factor for all bands need not touch the values: integers are copied as they are.
    uniform = gains is not None and offsets is None and bool((gains == gains[0]).all()) and gains[0] > 0
    if uniform and gains is not None and to_reflectance is not None:
        to_reflectance, gains = to_reflectance * float(gains[0]), None
    pixels = stored
    if missing or gains is not None or offsets is not None or unsigned:
        pixels = ScaledPixels(stored, missing, gains, offsets, unsigned=unsigned)
    return InterpretedValues(
        pixels=pixels,
        quantity="counts" if to_reflectance is None else "reflectance",
        to_reflectance=to_reflectance,
        saturation=_saturation(level, gains, offsets, pixels.dtype),
        warnings=warnings,
    )


def _per_band(numbers: Floats | None, bands: int, *, idle: float) -> Floats | None:
    """Numbers (bands,); None where there are none, or where all are ``idle`` and change nothing."""
    if numbers is None or (numbers == idle).all():
        return None
    return np.broadcast_to(numbers, (bands,)).astype(np.float64)


def sampled(pixels: Pixels) -> Array:
    """Rows spread evenly over the cube, (n, cols, bands)."""
    rows, cols, bands = pixels.shape
    most = int(np.clip(_SAMPLED_VALUES // (cols * bands), 1, _SAMPLED_ROWS))
    return np.concatenate([to_bip(pixels.block(r, r + 1)) for r in sampled_rows(rows, most)])


def _thinned(values: Array, *, by_pixel: bool = False) -> Array:
    """Fewer of the sample's pixels where there are very many: enough for percentiles, or for a plateau."""
    most = _PERCENTILE_VALUES if by_pixel else _SAMPLED_VALUES // 2
    step = max(1, values.size // most)
    return values[:, ::step] if step > 1 else values


def _missing(raw: Array, dtype: np.dtype, declared: Declared) -> tuple[Missing, Array, Notices]:
    """Which stored values stand for none, the sample without them, and warnings."""
    warnings: Notices = ()
    finite = [value for value in declared.no_data if np.isfinite(value)]
    possible = tuple(value for value in finite if _holds(dtype, value))
    impossible = [f"{value:g}" for value in finite if value not in possible]
    if impossible:
        text = f"The file's no-data value {', '.join(impossible)} is none that {dtype} can hold: nothing is left out."
        warnings = (Notice("no_data_impossible", text),)
    low, high = declared.valid or (-np.inf, np.inf)
    missing = Missing(possible, low, high)
    values = _without_missing(raw, missing)
    guessed = undeclared_no_data(values) if dtype.kind in "if" else None
    if guessed is not None:
        text = f"{guessed:g} stands where values are missing, though the file does not say so: it is taken for none."
        warnings += (Notice("no_data_undeclared", text),)
        missing = Missing((*possible, guessed), low, high)
        values = _without_missing(raw, missing)
    if dtype.kind == "f" or dtype.itemsize > 2:
        lowest, highest = bounds(values)
        beyond = int(((values < lowest) | (values > highest)).sum())
        if beyond:
            share = beyond / max(int(np.isfinite(values).sum()), 1)
            text = f"About {share:.2%} of the values lie far beyond all others (largest {_largest(values):.3g})"
            warnings += (Notice("values_absurd", f"{text}: dead pixels, or no-data. They are taken for no value."),)
            missing = Missing(missing.equal, max(low, lowest), min(high, highest))
            values = _without_missing(raw, missing)
    dead = dead_elements(values)
    if dead is not None:
        columns = np.flatnonzero(dead.any(1))
        listed = ", ".join(map(str, columns[:8].tolist())) + (", ..." if len(columns) > 8 else "")
        text = f"{int(dead.sum())} detector elements are dead (columns {listed}); their values are taken for none."
        warnings += (Notice("detector_dead", text),)
        missing = Missing(missing.equal, missing.low, missing.high, dead)
        values = np.where(dead, np.nan, values)
    return missing, values, warnings


def _largest(values: Array) -> float:
    finite = values[np.isfinite(values)]
    return float(finite[np.abs(finite).argmax()])


def _holds(dtype: np.dtype, value: float) -> bool:
    """Whether a value of this type can be ``value``."""
    if dtype.kind == "f":
        return bool(np.isfinite(dtype.type(value)))
    info = np.iinfo(dtype)
    return value == int(value) and info.min <= value <= info.max


def _without_missing(raw: Array, missing: Missing) -> Array:
    out = raw.astype(np.float64 if raw.dtype.itemsize > 2 and raw.dtype != np.float32 else np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        missing.mark(raw, out, missing.dead)
    return out


def _to_reflectance(converted: Array, declared: Declared, *, real: bool) -> tuple[float | None, Notices]:
    """What turns values into reflectance; None where they are something else."""
    bright = _bright(converted)
    if declared.divisor is None:
        seems = real and (_looks_like_reflectance(converted) or _declared_reflectance(converted, declared))
        if seems and declared.other is not None:
            text = f"The file calls its values {declared.other}: they are kept as they stand, and not as reflectance."
            return None, (Notice(QUANTITY_OTHER, text),)
        return (1.0 if seems else None), ()
    factor = declared.divisor
    if real and bright is not None and bright / factor < _LEAST_BRIGHT and _looks_like_reflectance(converted):
        text = f"'{declared.name('divisor')} = {factor:g}', but the values are reflectance already, up to {bright:.3g}"
        return 1.0, (Notice("reflectance_factor_unused", f"{text}: they are used as they stand."),)
    return 1.0 / factor, ()


def _declared_reflectance(converted: Array, declared: Declared) -> bool:
    """Whether scaled values of a data set called reflectance are to be believed, however dark or bright."""
    bright = _bright(converted)
    scaled = declared.gains is not None or declared.offsets is not None
    return declared.reflectance and scaled and bright is not None and bright <= _MOST_PERCENT


def _bright(converted: Array) -> float | None:
    finite = converted[np.isfinite(converted)]
    return float(np.percentile(finite, 99.9)) if finite.size else None


def _looks_like_reflectance(values: Array) -> bool:
    values = values[np.isfinite(values)].astype(np.float64)
    if not values.size or not values.any():
        return False
    # Not minimum and maximum: a few dead or glinting pixels do not change what is measured.
    low, high = np.percentile(values, (0.1, 99.9))
    return bool(low >= _REFLECTANCE_RANGE[0] and high <= _REFLECTANCE_RANGE[1])


def _percent_warning(converted: Array) -> Notices:
    """A warning where what the file calls reflectance was not taken for it, and looks like percent."""
    bright = _bright(converted)
    if bright is None or not _REFLECTANCE_RANGE[1] < bright <= _MOST_PERCENT:
        return ()
    text = "The file calls its values reflectance, but they look like percent; they are kept as they stand."
    return (Notice("reflectance_implausible", text),)


def implausible(reflectance: Array, *, calibrated: bool = False) -> Notices:
    """A warning where what is called reflectance, a sample of it in good bands, cannot be.

    ``calibrated``: it was made of counts and references.
    """
    finite = reflectance[np.isfinite(reflectance)]
    if not finite.size or not finite.any():
        return ()
    middle, bright = (float(v) for v in np.percentile(finite, (50, 99.9)))
    text = ""
    if bright <= 0:
        text = "Nothing reflects more than nothing: all values are zero or negative."
    elif bright < _LEAST_BRIGHT:
        text = f"Nothing reflects more than {bright:.2g}: the scale of the reflectance seems wrong."
    elif middle > _REFLECTANCE_RANGE[1]:
        cause = " They may be percent." if bright <= _MOST_PERCENT else ""
        if calibrated:
            cause = " The white reference seems to be of a shorter exposure or less light."
        text = f"Half of the cube reflects more than {middle:.3g}: the scale seems wrong.{cause}"
    elif middle < _REFLECTANCE_RANGE[0]:
        text = f"Half of the cube has a reflectance below {middle:.2g}: offset or dark reference seem wrong."
    return (Notice("reflectance_implausible", text),) if text else ()


def _saturation(level: float | None, gains: Floats | None, offsets: Floats | None, dtype: np.dtype) -> Floats | None:
    """The clip level as values read: () or (B,), by the arithmetic of the values themselves; NaN where unknown."""
    if level is None:
        return None
    if gains is None and offsets is None:
        return np.asarray(level, np.float64)
    gain = np.ones(1) if gains is None else gains
    top = np.multiply(dtype.type(level), gain.astype(dtype), dtype=dtype)
    if offsets is not None:
        top = top + offsets.astype(dtype)
    # With a negative gain the brightest is the smallest: no "at least" finds it.
    return np.where(gain > 0, top, np.nan).astype(np.float64)
