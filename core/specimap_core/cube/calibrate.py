"""Raw counts to reflectance with a white and a dark reference of the same instrument.

reflectance = (raw - dark) / (white - dark), for each column and band: each has its own response. The
references are averaged over their rows.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.cube.model import Cube
from specimap_core.cube.pixels import Pixels
from specimap_core.cube.strided import to_bip
from specimap_core.cube.values import QUANTITY_OTHER, implausible, sampled
from specimap_core.errors import CubeContentError
from specimap_core.notices import Notice, Notices

# Fewer columns x bands of a saturated white than this are dead elements.
_LEAST_CLIPPED_WHITE = 0.002
# Wider apart than a band of any imager: the reference was taken with other settings.
_WAVELENGTH_TOLERANCE_NM = 1.0
_EXPOSURE_TOLERANCE = 0.01
_WAVELENGTHS_DIFFER = {"white": "white_wavelengths_differ", "dark": "dark_wavelengths_differ"}
# A spectrum of fewer bands may well be zero in all.
_LEAST_BANDS = 3


def calibrated(raw: Cube, white: Cube, dark: Cube | None) -> Cube:
    """The cube of reflectance (float32) of a raw cube. Without a dark reference, 0 counts are taken as dark.

    Where the white is not brighter than the dark, a reference has no value, or the raw cube holds zeros in all bands,
    reflectance is NaN. Saturation stays that of the raw counts. Raises CubeContentError for a reference whose columns
    or bands do not fit.
    """
    warnings: Notices = _check_fit(raw, white, "white") + (_check_fit(raw, dark, "dark") if dark else ())
    scales, about_units = _to_common_units(raw, white, dark)
    warnings += about_units
    white_line = _mean_line(white)
    warnings += _saturation_warning(white, white_line)
    white_line *= scales[0]
    dark_line = np.zeros_like(white_line) if dark is None else _mean_line(dark) * scales[1]
    if dark is None:
        warnings += (Notice("dark_missing", "No dark reference was given; a dark signal of zero is assumed."),)
    span = np.broadcast_to(white_line - dark_line, (raw.cols, raw.bands))
    usable = span > 0  # False for NaN, too
    if not usable.any():
        raise CubeContentError(
            "The white reference is nowhere brighter than the dark one.",
            advice="Check that the two references are not exchanged.",
        )
    if not usable.all():
        count = int(usable.size - usable.sum())
        text = f"At {count} of {usable.size} columns x bands the white is not brighter than the dark."
        warnings += (Notice("reference_invalid", f"{text} Reflectance is unknown (NaN) there."),)
    gain = np.full(span.shape, np.nan)
    np.divide(1.0, span, out=gain, where=usable)
    pixels = _CalibratedPixels(
        raw.pixels,
        np.broadcast_to(dark_line, span.shape).astype(np.float32),
        gain.astype(np.float32),
    )
    about_raw = tuple(w for w in raw.warnings if w.code != QUANTITY_OTHER)
    warnings += implausible(sampled(pixels)[..., ~raw.bad_bands], calibrated=True)
    level = None if raw.saturation is None else pixels.calibrated(raw.saturation.astype(np.float32))
    return replace(
        raw,
        pixels=pixels,
        files=raw.files + white.files + (dark.files if dark else ()),
        quantity="reflectance",
        to_reflectance=1.0,
        saturation=None if level is None else level.astype(np.float64),
        warnings=about_raw + warnings,
    )


def _check_fit(raw: Cube, reference: Cube, name: Literal["white", "dark"]) -> Notices:
    if reference.bands != raw.bands or reference.cols not in (1, raw.cols):
        raise CubeContentError(
            f"The {name} reference has {reference.cols} columns and {reference.bands} bands, "
            f"the cube {raw.cols} and {raw.bands}.",
            advice=f"Give the {name} reference that was recorded with the cube, with the same binning.",
            reference=name,
            expected=[raw.cols, raw.bands],
            found=[reference.cols, reference.bands],
        )
    warnings: Notices = ()
    if raw.exposure and reference.exposure and abs(reference.exposure / raw.exposure - 1) > _EXPOSURE_TOLERANCE:
        text = (
            f"The {name} reference was exposed {reference.exposure / raw.exposure:.3g} times as long as the cube, as "
            "their files say; values are used as they stand."
        )
        warnings = (Notice("reference_exposure_differs", text),)
    apart = np.abs(reference.wavelengths_nm - raw.wavelengths_nm)
    if (apart > _WAVELENGTH_TOLERANCE_NM).any():  # NaN, where either names none, does not count
        text = f"The {name} reference's wavelengths are up to {np.nanmax(apart):.1f} nm off the cube's."
        warnings += (Notice(_WAVELENGTHS_DIFFER[name], text),)
    return warnings


def _to_common_units(raw: Cube, white: Cube, dark: Cube | None) -> tuple[tuple[float, float], Notices]:
    """What values of white and dark are multiplied by to be in the units of the raw cube, and a warning."""
    own = [cube.to_reflectance for cube in (raw, white, dark or white)]
    if all(factor is None for factor in own):
        return (1.0, 1.0), ()
    if any(factor is None for factor in own):
        text = "Cube and references are not of the same kind: some are counts, some reflectance already."
        return (1.0, 1.0), (Notice("reference_units_differ", text),)
    raw_factor, white_factor, dark_factor = (factor or 1.0 for factor in own)
    return (white_factor / raw_factor, dark_factor / raw_factor), ()


def _saturation_warning(white: Cube, line: Floats) -> Notices:
    """A warning where the white reference itself clips, on average over its rows, in a good band."""
    if white.saturation is None:
        return ()
    with np.errstate(invalid="ignore"):
        clipped = (line >= white.saturation)[:, ~white.bad_bands]
    share = float(clipped.mean()) if clipped.size else 0.0
    if share <= _LEAST_CLIPPED_WHITE:
        return ()
    return (Notice("white_saturated", f"The white reference is saturated in {share:.1%} of its columns x bands."),)


def _mean_line(reference: Cube) -> Floats:
    """Mean over the rows, (cols, bands), NaN left out; NaN where there is nothing else."""
    total = np.zeros((reference.cols, reference.bands))
    count = np.zeros((reference.cols, reference.bands), np.int64)
    step = reference.pixels.strip_rows()
    for start in range(0, reference.rows, step):
        strip = reference.read_rows(start, min(start + step, reference.rows))
        known = np.isfinite(strip)
        total += np.where(known, strip, 0).sum(0, dtype=np.float64)
        count += known.sum(0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


class _CalibratedPixels(Pixels):
    def __init__(self, raw: Pixels, dark: NDArray[np.float32], gain: NDArray[np.float32]) -> None:
        self.shape = raw.shape
        self.dtype = np.dtype(np.float32)
        self._raw, self._dark, self._gain = raw, dark, gain

    def block(self, start: int, stop: int) -> Array:
        raw = to_bip(self._raw.block(start, stop))
        out = self.calibrated(raw)
        out[_unrecorded(raw)] = np.nan
        return out

    def calibrated(self, raw: Array) -> Array:
        """Raw values, of a shape that broadcasts to (cols, bands), as reflectance."""
        out = np.subtract(raw, self._dark, dtype=np.float32, casting="same_kind")
        out *= self._gain
        return out

    def band(self, index: int) -> Array:
        values = self._raw.band(index).astype(np.float32)
        values -= self._dark[:, index]
        values *= self._gain[:, index]
        values[self._without_record] = np.nan
        return values

    @cached_property
    def _without_record(self) -> NDArray[np.bool_]:
        step = self.strip_rows()
        starts = range(0, self.shape[0], step)
        return np.concatenate([_unrecorded(to_bip(self._raw.block(s, min(s + step, self.shape[0])))) for s in starts])

    def strip_rows(self) -> int:
        # A quarter: raw values, differences and products of a strip are alive at once.
        return max(1, super().strip_rows() // 4)


def _unrecorded(raw: Array) -> NDArray[np.bool_]:
    """Which pixels (n, cols) of a block hold zeros in all bands, as dropped frames do: a dark signal is above zero."""
    bands = raw.shape[2]
    # One band tells for nearly all of them.
    found = np.asarray(raw[..., bands // 2] == 0)
    if bands < _LEAST_BANDS:
        return np.zeros_like(found)
    found[found] = ~raw[found].any(-1)
    return found
