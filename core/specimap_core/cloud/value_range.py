"""Measure the range of a cube's values, so that 16 bits hold them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Array
from specimap_core.cloud.saturation import band_runs
from specimap_core.cloud.schema import TILE, SpectraSource

_SAMPLED = 400_000
# So few values may be clipped, where keeping them would make all others coarse.
_PERCENTILES = (0.05, 99.95)
# Outliers that widen the range of counts less than this are kept.
_WORTH_KEEPING = 4.0
_ROOM_BELOW = 0.1


@dataclass(frozen=True, eq=False)
class Extent:
    """Smallest and largest finite value of the good bands; a ``sample`` of them (n,); whether they are ``whole``."""

    low: float
    high: float
    sample: Array
    whole: bool

    def within(self, width: float | None) -> tuple[float, float]:
        """The range to store: all values, unless few reach far beyond the others.

        ``width`` is what can be stored without loss: a wider range is cut, at its ends, to what nearly all values
        take, or to ``width`` if that is more. Where that does not suffice, or there is no ``width``, it is cut only if
        that makes it four times finer.
        """
        low, high = self.low, self.high
        if high - low <= (width or 0.0) or not self.sample.size:
            return low, high
        usual_low, usual_high = (float(v) for v in np.percentile(self.sample, _PERCENTILES))
        span = usual_high - usual_low
        if width is None or usual_high - min(usual_low, 0.0) > width:
            return (low, high) if high - low <= _WORTH_KEEPING * span or span == 0 else (usual_low, usual_high)
        # Negative values first: they are noise around nothing, the large ones glints.
        low = max(low, min(usual_low, 0.0) - _ROOM_BELOW * width, usual_high - width)
        return low, low + width


def extent_of(source: SpectraSource) -> Extent:
    """Read the cube once."""
    good = ~np.asarray(source.bad_bands, bool)
    runs = band_runs(good) or [slice(0, source.bands)]
    every = max(1, source.rows * source.cols * source.bands // _SAMPLED)
    every += every % 2 == 0
    low, high, sample = np.inf, -np.inf, [np.empty(0)]
    for start in range(0, source.rows, TILE):
        values = source.read_rows(start, min(start + TILE, source.rows)).reshape(-1, source.bands)
        for run in runs:
            part = values[:, run]
            least, most = part.min(), part.max()
            if source.dtype.kind == "f" and not (np.isfinite(least) and np.isfinite(most)):
                part = part[np.isfinite(part)]
                if not part.size:
                    continue
                least, most = part.min(), part.max()
            low, high = min(low, float(least)), max(high, float(most))
            sample.append(part.reshape(-1)[::every].astype(np.float64))
    if low > high:
        low = high = 0.0
    taken = np.concatenate(sample)
    whole = source.dtype.kind != "f" or bool((taken == np.rint(taken)).all() and low == int(low) and high == int(high))
    return Extent(low, high, taken, whole)
