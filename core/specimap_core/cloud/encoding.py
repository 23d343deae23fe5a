"""Encode values of a cube as the 16-bit values of a cloud, and flag the saturated, missing and clipped ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cloud.saturation import SaturationCheck, band_runs
from specimap_core.cloud.schema import NO_VALUE, SCALE_FACTOR, TILE, Flag, SpectraSource
from specimap_core.cloud.value_range import Extent, extent_of

LARGEST = 65535
# Blocks of this many spectra stay in the second-level cache between the passes over them.
_BLOCK = 256
# A spectrum of fewer bands may well be zero in all.
_LEAST_BANDS = 3
# Values so many ranges below or above what can be stored were not measured.
_FAR_BELOW, _FAR_ABOVE = 0.5, 8.0


@dataclass(frozen=True)
class Encoding:
    """How values are stored, and what decodes them.

    ``stored = round(value * gain + bias)``, clipped to 0..``top``; ``decoded = stored * scale_factor + add_offset``.
    ``fills``: what is no finite number is stored as NO_VALUE, which lies above ``top``.
    """

    quantity: str
    scale_factor: float = 1.0
    add_offset: float = 0.0
    gain: float = 1.0
    bias: float = 0.0
    fills: bool = False

    @property
    def top(self) -> int:
        """The largest stored value that is one."""
        return LARGEST - 1 if self.fills else LARGEST

    @classmethod
    def of(cls, source: SpectraSource) -> Self:
        """The encoding that loses least. Values that may not fit are read once to find their range."""
        fills = source.dtype.kind == "f"
        factor = source.to_reflectance
        if factor is not None:
            gain = factor / SCALE_FACTOR
            # A gain of 1 up to rounding means that the bits can be copied.
            gain = 1.0 if abs(gain - 1) < 1e-9 else gain
            if source.dtype.kind == "u" and np.iinfo(source.dtype).max * gain <= LARGEST:
                return cls("reflectance", SCALE_FACTOR, gain=gain)
            return cls._reflectance(extent_of(source), factor, gain, fills)
        if source.dtype in (np.dtype("u1"), np.dtype("u2")):
            return cls(source.quantity)
        return cls._counts(source.quantity, extent_of(source), fills)

    @classmethod
    def _reflectance(cls, extent: Extent, factor: float, gain: float, fills: bool) -> Self:
        """Steps of 1e-4 from zero or the smallest value below it; coarser only where many values are far larger."""
        room = LARGEST - fills
        low, high = (bound * factor for bound in extent.within(room * SCALE_FACTOR / factor))
        first = min(np.floor(low / SCALE_FACTOR + 1e-3), 0.0)
        if high / SCALE_FACTOR - first > room + 1:
            low = min(low, 0.0)
            scale = (high - low) / room
            return cls("reflectance", scale, low, factor / scale, -low / scale, fills)
        return cls("reflectance", SCALE_FACTOR, round(float(first * SCALE_FACTOR), 4), gain, float(-first), fills)

    @classmethod
    def _counts(cls, quantity: str, extent: Extent, fills: bool) -> Self:
        """As they are where they fit, else moved, else scaled."""
        low, high = extent.within(None)
        span, room = high - low, LARGEST - fills
        if extent.whole and low >= 0 and high <= room:
            return cls(quantity, fills=fills)
        scale = 1.0 if (extent.whole and span <= room) or span == 0 else span / room
        return cls(quantity, scale, low, 1 / scale, -low / scale, fills)

    def attributes(self) -> dict[str, object]:
        """Attributes of the array ``spectra``: CF's, which xarray decodes, and the quantity."""
        attributes: dict[str, object] = {"quantity": self.quantity}
        if self.scale_factor != 1:
            attributes["scale_factor"] = self.scale_factor
        if self.add_offset != 0:
            attributes["add_offset"] = self.add_offset
        if self.fills:
            attributes["_FillValue"] = NO_VALUE
        if self.quantity == "reflectance":
            attributes["units"] = "1"
        return attributes

    def scale(self, values: Array, work: Array) -> bool:
        """Encode values (n, B) into the floats ``work`` (n, B), rounded; whether all of them can be stored so."""
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is clipped later
            np.multiply(values, self.gain, out=work, casting="unsafe")
            if self.bias:
                np.add(work, self.bias, out=work)
            np.rint(work, out=work)
        # A NaN survives both.
        return bool(work.min() >= 0 and work.max() <= self.top)


@dataclass
class EncodingCounts:
    """What was found while spectra were gathered: values of good bands that were clipped at either end, or left out."""

    below: int = 0
    above: int = 0
    absurd: int = 0


class SpectraEncoder:
    """Picks spectra from the values of some rows, encodes them and flags their points, while they are in cache."""

    def __init__(self, source: SpectraSource, encoding: Encoding, saturation: float | None) -> None:
        self.counts = EncodingCounts()
        self._encoding = encoding
        self._cols = source.cols
        level = source.saturation if saturation is None else np.asarray(saturation, np.float64)
        self._saturated = SaturationCheck(source, level)
        self._runs = band_runs(~np.asarray(source.bad_bands, bool))
        self._good = np.flatnonzero(~np.asarray(source.bad_bands, bool))
        self._copies = source.dtype == np.uint16 and encoding.gain == 1 and encoding.bias == 0
        # float32 holds 24 bits: enough for reflectance and for 16-bit counts.
        narrow = source.dtype.itemsize <= 2 or source.dtype == np.float32
        self._picked = np.empty((_BLOCK, source.bands), source.dtype)
        self._work = np.empty((_BLOCK, source.bands), np.float32 if narrow else np.float64)

    def gather(self, values: Array, take: NDArray[np.intp], out: NDArray[np.uint16]) -> NDArray[np.uint8]:
        """Encode the rows ``take`` (n,) of whole rows of the cube (m, B) into ``out`` (n, B).

        Gives the flags SATURATED and NO_DATA (n,) of the spectra.
        """
        flags = np.zeros(len(take), np.uint8)
        for start in range(0, len(take), _BLOCK):
            rows, target = take[start : start + _BLOCK], out[start : start + _BLOCK]
            picked = target if self._copies else self._picked[: len(rows)]
            # mode="clip" writes without a buffer; the indices are known to be good.
            np.take(values, rows, 0, out=picked, mode="clip")
            found = flags[start : start + _BLOCK]
            found[self._saturated(picked, rows)] |= np.uint8(Flag.SATURATED)
            found[self._empty(picked)] |= np.uint8(Flag.NO_DATA)
            if not self._copies:
                work = self._work[: len(rows)]
                if not self._encoding.scale(picked, work):
                    self._clip_and_flag(picked, work, found)
                np.copyto(target, work, casting="unsafe")
        return flags

    def _empty(self, picked: Array) -> NDArray[np.intp]:
        """Which spectra are zero in all good bands: nothing was recorded there."""
        if len(self._good) < _LEAST_BANDS:
            return np.empty(0, np.intp)
        # One band tells for nearly all of them.
        suspects = np.flatnonzero(picked[:, self._good[len(self._good) // 2]] == 0)
        return suspects[~picked[np.ix_(suspects, self._good)].any(1)]

    def _clip_and_flag(self, picked: Array, work: Array, flags: NDArray[np.uint8]) -> None:
        """Bring into range what cannot be stored, and flag and count it where the band is good."""
        top = self._encoding.top
        missing, absurd = np.zeros((2, *picked.shape), bool)
        if self._encoding.fills:
            missing = ~np.isfinite(picked)
            absurd = ~missing & ((work < -_FAR_BELOW * top) | (work > _FAR_ABOVE * top))
            missing |= absurd
        above, below = (work > top) & ~missing, (work < 0) & ~missing
        for run in self._runs:
            flags[missing[:, run].any(1)] |= np.uint8(Flag.NO_DATA)
            flags[above[:, run].any(1)] |= np.uint8(Flag.SATURATED)
            self.counts.above += int(above[:, run].sum())
            self.counts.below += int(below[:, run].sum())
            self.counts.absurd += int(absurd[:, run].sum())
        np.clip(work, 0, top, out=work)
        work[missing] = NO_VALUE


def strips(source: SpectraSource) -> Iterator[tuple[int, int]]:
    """Row ranges of a cube, a tile high."""
    for start in range(0, source.rows, TILE):
        yield start, min(start + TILE, source.rows)
