"""How raw values of a cube become the 16-bit values of a cloud, and which of them are saturated."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from specimap.core.cloud.schema import SCALE_FACTOR, TILE, SpectraSource
from specimap.core.geometry import Array

LARGEST = 65535
# Blocks of this many spectra stay in the second-level cache between the passes over them.
_BLOCK = 256


@dataclass(frozen=True)
class Encoding:
    """How values are stored, and what decodes them.

    ``stored = round(raw * gain + bias)``, clipped to 0..65535; ``decoded = stored * scale_factor + add_offset``.
    """

    quantity: str
    scale_factor: float = 1.0
    add_offset: float = 0.0
    gain: float = 1.0
    bias: float = 0.0

    @classmethod
    def of(cls, source: SpectraSource) -> Self:
        """The encoding that loses least. Counts that may not fit are read once to find their range."""
        if source.to_reflectance is not None:
            gain = source.to_reflectance / SCALE_FACTOR
            # A gain of 1 up to rounding means that the bits can be copied.
            gain = 1.0 if abs(gain - 1) < 1e-9 else gain
            return cls("reflectance", scale_factor=SCALE_FACTOR, gain=gain)
        if source.dtype in (np.dtype("u1"), np.dtype("u2")):
            return cls(source.quantity)
        low, high = _range(source)
        span = high - low
        whole = source.dtype.kind != "f"
        if whole and low >= 0 and high <= LARGEST:
            return cls(source.quantity)
        scale = 1.0 if (whole and span <= LARGEST) or span == 0 else span / LARGEST
        return cls(source.quantity, scale, low, 1 / scale, -low / scale)

    def attributes(self) -> dict[str, object]:
        """Attributes of the array ``spectra``: CF's, which xarray decodes, and the quantity."""
        attributes: dict[str, object] = {"quantity": self.quantity}
        if self.scale_factor != 1:
            attributes["scale_factor"] = self.scale_factor
        if self.add_offset != 0:
            attributes["add_offset"] = self.add_offset
        if self.quantity == "reflectance":
            attributes["units"] = "1"
        return attributes

    def scale(self, raw: Array, work: Array) -> None:
        """Encode raw (n, B) into the floats ``work`` (n, B), whole numbers in 0..65535; NaN becomes 0."""
        with np.errstate(over="ignore"):  # what overflows is clipped below
            np.multiply(raw, self.gain, out=work, casting="unsafe")
        if self.bias:
            np.add(work, self.bias, out=work)
        np.rint(work, out=work)
        np.clip(work, 0, LARGEST, out=work)
        # Clipping took care of the infinite; a NaN survives it and any sum.
        if np.isnan(work.sum()):
            np.nan_to_num(work, copy=False)


class Gatherer:
    """Picks spectra from raw rows, encodes them and says which are saturated, while they are in cache."""

    def __init__(self, source: SpectraSource, encoding: Encoding, saturation: float | None) -> None:
        self._encoding = encoding
        self._saturated = saturation_check(source, saturation)
        self._copies = source.dtype == np.uint16 and encoding.gain == 1 and encoding.bias == 0
        # float32 holds 24 bits: enough for reflectance and for 16-bit counts.
        narrow = source.dtype.itemsize <= 2 or source.dtype == np.float32
        self._picked = np.empty((_BLOCK, source.bands), source.dtype)
        self._work = np.empty((_BLOCK, source.bands), np.float32 if narrow else np.float64)

    def gather(self, raw: Array, take: NDArray[np.intp], out: NDArray[np.uint16]) -> NDArray[np.bool_]:
        """Encode the rows ``take`` (n,) of raw (m, B) into ``out`` (n, B); which are saturated, (n,)."""
        saturated = np.empty(len(take), bool)
        for start in range(0, len(take), _BLOCK):
            rows, target = take[start : start + _BLOCK], out[start : start + _BLOCK]
            picked = target if self._copies else self._picked[: len(rows)]
            # mode="clip" writes without a buffer; the indices are known to be good.
            np.take(raw, rows, 0, out=picked, mode="clip")
            saturated[start : start + _BLOCK] = self._saturated(picked)
            if not self._copies:
                work = self._work[: len(rows)]
                self._encoding.scale(picked, work)
                np.copyto(target, work, casting="unsafe")
        return saturated


def saturation_check(source: SpectraSource, saturation: float | None) -> Callable[[Array], NDArray[np.bool_]]:
    """A function: raw (n, B) -> (n,) bool, whether a good band is saturated or not finite.

    Saturated is ``saturation`` and above; by default the largest value of an integer type.
    """
    kind = source.dtype.kind
    limit = saturation if saturation is not None else np.inf if kind == "f" else np.iinfo(source.dtype).max
    runs = _runs(~np.asarray(source.bad_bands, bool))

    def check(raw: Array) -> NDArray[np.bool_]:
        bad = np.zeros(len(raw), bool)
        for run in runs:
            part = raw[:, run]
            # One maximum of the block is four times cheaper than one per spectrum, and settles most blocks.
            if not part.size or (part.max() < limit and (kind != "f" or part.min() > -np.inf)):
                continue
            bad |= ~(part.max(1) < limit)
            if kind == "f":
                bad |= part.min(1) == -np.inf
        return bad

    return check


def strips(source: SpectraSource) -> Iterator[tuple[int, int]]:
    """Row ranges of a cube, a tile high."""
    for start in range(0, source.rows, TILE):
        yield start, min(start + TILE, source.rows)


def _runs(good: NDArray[np.bool_]) -> list[slice]:
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _range(source: SpectraSource) -> tuple[float, float]:
    """Smallest and largest finite value of the good bands (of all where none is good)."""
    good = ~np.asarray(source.bad_bands, bool)
    runs = _runs(good) or [slice(0, source.bands)]
    low, high = np.inf, -np.inf
    for start, stop in strips(source):
        raw = source.read_rows(start, stop).reshape(-1, source.bands)
        for run in runs:
            part = raw[:, run]
            least, most = part.min(), part.max()
            if source.dtype.kind == "f" and not (np.isfinite(least) and np.isfinite(most)):
                part = part[np.isfinite(part)]
                if not part.size:
                    continue
                least, most = part.min(), part.max()
            low, high = min(low, float(least)), max(high, float(most))
    return (low, high) if low <= high else (0.0, 0.0)
