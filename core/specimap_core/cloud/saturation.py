"""Find saturated spectra by their values while these are in cache."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cloud.schema import SpectraSource


class SaturationCheck:
    """Whether a good band of a spectrum reaches ``level``, (), (B,) or (cols, B); nothing does where that is NaN.

    Where it is None, an integer type's largest value is the level.
    """

    def __init__(self, source: SpectraSource, level: NDArray[np.float64] | None) -> None:
        if level is None and source.dtype.kind in "iu":
            level = np.asarray(np.iinfo(source.dtype).max, np.float64)
        self._cols = source.cols
        self._parts: list[tuple[slice, float, Array]] = []
        if level is None:
            return
        whole = np.broadcast_to(level, (source.bands,)) if level.ndim < 2 else level
        for run in band_runs(~np.asarray(source.bad_bands, bool)):
            part = whole[..., run]
            if not np.isnan(part).all():
                lowest = float(np.nanmin(part))
                self._parts.append((run, lowest, np.asarray(lowest) if (part == lowest).all() else part))

    def __call__(self, values: Array, rows: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Values (n, B) of the pixels ``rows`` (n,), counted along whole rows of the cube: saturated or not, (n,)."""
        found = np.zeros(len(values), bool)
        for run, lowest, level in self._parts:
            part = values[:, run]
            # One maximum of the block is four times cheaper than one per spectrum, and settles most blocks; one that
            # is NaN does not.
            if not part.size or part.max() < lowest:
                continue
            own = level[rows % self._cols] if level.ndim == 2 else level
            # Neither NaN nor what is infinite was measured.
            found |= ((part >= own) & (part < np.inf)).any(1)
        return found


def band_runs(good: NDArray[np.bool_]) -> list[slice]:
    """Runs of neighbouring good bands."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
