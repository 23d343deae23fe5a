"""Convert wavelengths to nanometres from whatever unit a file gives; unknown ones stay so, with a warning."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.cube.spectral_units import Unit, read_unit
from specimap_core.notices import Notice, Notices

# No optical instrument reaches beyond: what lies outside is in another unit, or no wavelength.
_SHORTEST_NM, _LONGEST_NM = 100.0, 100_000.0
# Whole numbers in steps of one from here on may be a spectrometer's nanometres.
_LEAST_STEPPED_NM = 200.0
# So few bands may truly lie at 1, 2 and 3 micrometres.
_FEW_BANDS = 3


def nanometres(values: Floats | None, units: str | None, bands: int) -> tuple[Floats, Notices]:
    """Wavelengths (bands,) in nm, NaN where the file does not say them, and what there is to warn of.

    ``units`` is the file's own word: a length, a wavenumber, a frequency or an energy. Where it is missing the
    numbers decide: all below 100 means micrometres, else nanometres. Where a length contradicts its numbers, and
    they make sense as nanometres or as micrometres, that is taken, with a warning. Band numbers, and what would lie
    outside 100 nm to 100 um, are no wavelengths: all are NaN then.
    """
    unknown = np.full(bands, np.nan)
    if values is None or values.size == 0:
        return unknown, (Notice("wavelengths_missing", "The cube's file names no wavelengths."),)
    if values.size != bands:
        text = f"The cube has {bands} bands, its file names {values.size} wavelengths; they are not used."
        return unknown, (Notice("wavelengths_count_mismatch", text),)
    values = values.astype(np.float64)
    unit = read_unit(units)
    if _are_band_numbers(values, unit):
        text = f"The cube's 'wavelengths' {_span(values)} are band numbers; its wavelengths are unknown."
        return unknown, (Notice("wavelengths_band_numbers", text),)
    if not (np.isfinite(values).all() and (values > 0).all()):
        text = "The cube's wavelengths are not all positive numbers; they are not used."
        return unknown, (Notice("wavelengths_invalid", text),)
    nm, warnings = _scaled(values, unit)
    if nm is None:
        return unknown, warnings
    return nm, warnings + _order_warnings(nm)


def _are_band_numbers(values: Floats, unit: Unit) -> bool:
    if unit.kind == "index":
        return True
    if values.size < 2 or not np.isfinite(values).all():
        return False
    whole = bool((values == np.round(values)).all())
    steps = np.diff(values)
    counted = whole and bool((steps == 1).all() or (steps == -1).all())
    from_first = counted and values.min() in (0, 1)
    if unit.kind == "length":
        if unit.factor == 1e3:
            return from_first and values.size > _FEW_BANDS
        return from_first or (counted and values.max() < _SHORTEST_NM)
    if unit.kind in ("none", "unrecognised"):
        # Micrometres are not whole, nor does a spectrometer begin at 150 nm.
        small = whole and values.min() > 0 and values.max() < _SHORTEST_NM
        return from_first or small or (counted and 0 < values.min() < _LEAST_STEPPED_NM)
    return False


def _scaled(values: Floats, unit: Unit) -> tuple[Floats | None, Notices]:
    """Wavelengths in nm; None where no reading of the numbers makes sense."""
    span = _span(values)
    if unit.kind not in ("none", "unrecognised"):
        nm = unit.to_nm(values)
        if _plausible(nm):
            return nm, ()
        guess = _guessed(values) if unit.kind == "length" else None
        if guess is not None:
            text = (
                f"The wavelengths' unit ({unit.word}) and their numbers {span} contradict each other; "
                f"they are taken as {guess[1]}."
            )
            return guess[0], (Notice("wavelength_units_contradict", text),)
        text = f"The wavelengths {span} in '{unit.word}' lie outside 100 nm to 100 um; they are not used."
        return None, (Notice("wavelengths_implausible", text),)
    guess = _guessed(values)
    if guess is None:
        text = f"The wavelengths {span} make no sense as nanometres or micrometres; they are not used."
        return None, (Notice("wavelengths_implausible", text),)
    if unit.kind == "unrecognised":
        text = f"The wavelengths' unit '{unit.word}' is not known; the numbers {span} are taken as {guess[1]}."
        return guess[0], (Notice("wavelength_units_unknown", text),)
    return guess[0], ()


def _guessed(values: Floats) -> tuple[Floats, str] | None:
    """The reading, nm or um, that the numbers allow; they allow at most one."""
    if _plausible(values):
        return values, "nanometres"
    if _plausible(values * 1e3):
        return values * 1e3, "micrometres"
    return None


def _plausible(nm: Floats) -> bool:
    # Rounded: bounds must not depend on the last digit of a conversion.
    return bool(np.round(nm.min(), 6) >= _SHORTEST_NM and np.round(nm.max(), 6) <= _LONGEST_NM)


def _order_warnings(nm: Floats) -> Notices:
    steps = np.diff(nm)
    if (steps > 0).all() or (steps < 0).all():
        return ()
    if np.unique(nm).size < nm.size:
        text = f"Several bands have the same wavelength: {nm.size - np.unique(nm).size} of {nm.size} are repeated."
        return (Notice("wavelengths_repeated", text),)
    at = int(np.flatnonzero(np.sign(steps) != np.sign(nm[-1] - nm[0]))[0])
    text = f"The wavelengths are not in order: band {at + 1} is at {nm[at]:g} nm, the next at {nm[at + 1]:g} nm."
    return (Notice("wavelengths_unordered", text),)


def _span(values: Floats) -> str:
    return f"{values[0]:g} ... {values[-1]:g}"


def bad_band_mask(flags: Floats | None, bands: int) -> tuple[np.typing.NDArray[np.bool_], Notices]:
    """Bad bands (bands,) from a bad-band list in which 0 marks a bad one, and what there is to warn of."""
    good = np.zeros(bands, bool)
    if flags is None:
        return good, ()
    if flags.size != bands:
        text = f"The cube has {bands} bands, its bad-band list {flags.size} entries; the list is not used."
        return good, (Notice("bad_bands_count_mismatch", text),)
    bad = ~(flags > 0)
    if bad.all():
        return good, (Notice("bad_bands_all", "The bad-band list marks every band as bad; it is not used."),)
    return bad, ()
