"""Scale the stored values of a cube: gains and offsets applied, no-data as NaN."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array, Floats
from specimap_core.cube.pixels import Pixels
from specimap_core.cube.strided import to_bip

# Numbers in text, and in another type than the data's, match up to this share of themselves.
_ROUNDING = 1e-6


@dataclass(frozen=True, eq=False)
class Missing:
    """Which stored values stand for none.

    ``equal``: these values; ``low``, ``high``: all outside of these; ``dead`` (cols, bands): detector elements that
    measure nothing.
    """

    equal: tuple[float, ...] = ()
    low: float = -np.inf
    high: float = np.inf
    dead: NDArray[np.bool_] | None = None

    def __bool__(self) -> bool:
        return bool(self.equal or np.isfinite([self.low, self.high]).any() or self.dead is not None)

    def mark(self, raw: Array, out: Array, dead: NDArray[np.bool_] | None) -> None:
        """Set ``out`` to NaN where the stored ``raw``, of the same shape, has no value."""
        whole = raw.dtype.kind in "iu"
        for given in self.equal:
            value = float(raw.dtype.type(given))
            if whole or value == 0:
                np.copyto(out, np.nan, where=raw == raw.dtype.type(given))
            else:
                reach = abs(value) * _ROUNDING
                np.copyto(out, np.nan, where=(raw >= value - reach) & (raw <= value + reach))
        if np.isfinite(self.low):
            np.copyto(out, np.nan, where=raw < self.low)
        if np.isfinite(self.high):
            np.copyto(out, np.nan, where=raw > self.high)
        if dead is not None:
            np.copyto(out, np.nan, where=dead)


class ScaledPixels(Pixels):
    """Floats with gains and offsets applied and no-data as NaN.

    ``gains`` and ``offsets`` (bands,) or None; ``unsigned``: as in Declared.
    """

    def __init__(
        self, stored: Pixels, missing: Missing, gains: Floats | None, offsets: Floats | None, *, unsigned: bool = False
    ) -> None:
        self.shape = stored.shape
        wide = stored.dtype.itemsize > 2 and stored.dtype != np.float32
        self.dtype = np.dtype(np.float64 if wide else np.float32)
        self._stored, self._missing, self._unsigned = stored, missing, unsigned
        self._gains = None if gains is None else gains.astype(self.dtype)
        self._offsets = None if offsets is None else offsets.astype(self.dtype)

    def block(self, start: int, stop: int) -> Array:
        return self._scaled(to_bip(self._stored.block(start, stop)), self._missing.dead, self._gains, self._offsets)

    def band(self, index: int) -> Array:
        dead = self._missing.dead
        return self._scaled(
            self._stored.band(index),
            None if dead is None else dead[:, index],
            None if self._gains is None else self._gains[index],
            None if self._offsets is None else self._offsets[index],
        )

    def strip_rows(self) -> int:
        # A quarter: stored values, masks and results of a strip are alive at once.
        return max(1, super().strip_rows() // 4)

    def _scaled(self, raw: Array, dead: NDArray[np.bool_] | None, gains: Array | None, offsets: Array | None) -> Array:
        raw = as_unsigned(raw) if self._unsigned else raw
        # What is too large for the type becomes infinite, which is no value either.
        with np.errstate(over="ignore", invalid="ignore"):
            out = raw.astype(self.dtype) if gains is None else np.multiply(raw, gains, dtype=self.dtype)
            if offsets is not None:
                out += offsets
            self._missing.mark(raw, out, dead)
        return out


def as_unsigned(raw: Array) -> Array:
    """Signed integers of native order, their bits read without sign."""
    return raw.view(raw.dtype.str.replace("i", "u"))
