"""Wavelengths in whatever unit a file gives them, in nanometres."""

from __future__ import annotations

import re

import numpy as np

from specimap.core.geometry import Floats

Warnings = tuple[tuple[str, str], ...]

_NM_PER_UNIT = {
    "nm": 1.0, "nanometer": 1.0, "nanometre": 1.0,
    "um": 1e3, "µm": 1e3, "μm": 1e3, "micrometer": 1e3, "micrometre": 1e3, "micron": 1e3,
    "mm": 1e6, "millimeter": 1e6, "millimetre": 1e6,
    "m": 1e9, "meter": 1e9, "metre": 1e9,
    "angstrom": 0.1, "å": 0.1,
}  # fmt: skip
_WAVENUMBER = re.compile(r"wave ?number|cm\s*\^?\{?-1|cm⁻¹|1\s*/\s*cm", re.IGNORECASE)
# No optical instrument reaches below 100 nm or above 100 um: smaller numbers are micrometres.
_SMALLEST_NM = 100.0


def nanometres(values: Floats | None, units: str | None, bands: int) -> tuple[Floats, Warnings]:
    """Wavelengths (bands,) in nm, NaN where the file does not say them, and what there is to warn of.

    ``units`` is the file's own word. Where it is missing or unknown the numbers decide: all below 100 means
    micrometres, else nanometres. Wavenumbers (cm-1) are turned into wavelengths.
    """
    unknown = np.full(bands, np.nan)
    if values is None or values.size == 0:
        return unknown, (("wavelengths_missing", "The cube's file names no wavelengths."),)
    if values.size != bands:
        text = f"The cube has {bands} bands, its file names {values.size} wavelengths; they are not used."
        return unknown, (("wavelengths_count_mismatch", text),)
    if not (np.isfinite(values).all() and (values > 0).all()):
        text = "The cube's wavelengths are not all positive numbers; they are not used."
        return unknown, (("wavelengths_invalid", text),)
    return _scaled(values.astype(np.float64), units), ()


def _scaled(values: Floats, units: str | None) -> Floats:
    word = (units or "").strip().lower()
    if _WAVENUMBER.search(word):
        return 1e7 / values
    factor = _NM_PER_UNIT.get(word) or _NM_PER_UNIT.get(word.rstrip("s"))
    if factor is None:
        factor = 1e3 if values.max() < _SMALLEST_NM else 1.0
    return values * factor


def bad_band_mask(flags: Floats | None, bands: int) -> tuple[np.typing.NDArray[np.bool_], Warnings]:
    """Bad bands (bands,) from a bad-band list in which 0 marks a bad one, and what there is to warn of."""
    good = np.zeros(bands, bool)
    if flags is None:
        return good, ()
    if flags.size != bands:
        text = f"The cube has {bands} bands, its bad-band list {flags.size} entries; the list is not used."
        return good, (("bad_bands_count_mismatch", text),)
    bad = ~(flags > 0)
    if bad.all():
        return good, (("bad_bands_all", "The bad-band list marks every band as bad; it is not used."),)
    return bad, ()
