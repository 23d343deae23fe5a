"""Values that no scene has: undeclared no-data, dead and hot detector elements, the level at which a sensor clips.

All are found in a sample of rows (n, cols, bands) in which what is known to have no value is NaN.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array

# Stored where there is nothing, whether the file says so or not.
_USUAL_NO_DATA = (-9999.0, -999.0, -32768.0, -32767.0)
_LEAST_NO_DATA_SHARE = 2e-4
# A gap of so many powers of two in the values of one scene: what lies beyond it was not measured.
_GAP = 5
_MOST_BEYOND = 0.25
# Larger than anything measured, in any unit, and than any integer.
_ABSURD = 2e19
_HOT = 3.0
_BRIGHT_PERCENT = 90.0
_NEIGHBOURS = 13
_LEAST_ROWS = 16
# Values within this share below the largest one: a scene thins out there, a clipped sensor does not.
_TOP_SHARE = 0.01
# As many values on the largest one are no chance, but a plateau.
_LEAST_PLATEAU = 8
_LEAST_PLATEAU_BELOW = 50
_FULL_SCALES = (1023.0, 4095.0, 16383.0)
# Stuck elements may lie above a plateau, if they are no more than this share.
_MOST_STUCK = 0.001


def undeclared_no_data(values: Array) -> float | None:
    """A usual no-data value that stands in the sample again and again, with nothing near it; None if there is none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return None
    low = float(finite.min())
    if low not in _USUAL_NO_DATA or (finite == low).mean() < _LEAST_NO_DATA_SHARE:
        return None
    others = finite[finite != low]
    return low if others.size and float(others.min()) > 0.5 * low else None


def bounds(values: Array) -> tuple[float, float]:
    """The stored values between which a sample's scene lies; infinite where nothing lies far beyond it."""
    finite = values[np.isfinite(values)]
    positive = finite[finite > 0]
    high = min(_upper_bound(positive[positive <= _ABSURD]), _ABSURD)
    inside = positive[positive <= high]
    low = -float(inside.max()) * 2.0**_GAP if inside.size else -_ABSURD
    least, most = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    return low if least < low else -np.inf, high if most > high else np.inf


def _upper_bound(positive: Array) -> float:
    """Below it the scene's positive values, above it a gap and few others, or copies of a single one."""
    if not positive.size:
        return np.inf
    exponents = np.frexp(positive)[1]
    least = int(exponents.min())
    filled = np.flatnonzero(np.bincount(exponents - least))
    for below, above in itertools.pairwise(filled.tolist()):
        if above - below > _GAP:
            limit = float(2.0 ** (below + least + 1))
            if float(np.ptp(positive[positive <= limit])) == 0:  # what fills a masked background, and no scene
                continue
            beyond = positive[positive > limit]
            copies = above - below > 2 * _GAP and beyond.size > 1 and float(np.ptp(beyond)) == 0
            if copies or beyond.size < _MOST_BEYOND * positive.size:
                return limit
    return np.inf


def dead_elements(values: Array) -> NDArray[np.bool_] | None:
    """Detector elements (cols, bands) stuck at zero or the largest value, or far above their neighbours in every row.

    None where there are none, or too few rows to tell.
    """
    rows, cols, _ = values.shape
    width = min(_NEIGHBOURS, cols - 1 + cols % 2)
    if rows < _LEAST_ROWS or width < 5 or not np.isfinite(values).any():
        return None
    known = np.isfinite(values).sum(0) >= rows // 2
    with np.errstate(all="ignore"):
        least = np.where(known, np.nanmin(np.where(np.isfinite(values), values, np.inf), 0), np.nan)
        most = np.where(known, np.nanmax(np.where(np.isfinite(values), values, -np.inf), 0), np.nan)
    bright = float(np.nanpercentile(values[::2, ::2], _BRIGHT_PERCENT))
    largest = float(values.max(initial=-np.inf, where=np.isfinite(values)))
    suspects = np.flatnonzero((((least == 0) & (most == 0)) | (least > bright)).any(0))
    dead = np.zeros(known.shape, bool)
    half = width // 2
    for start in range(0, len(suspects), 64):
        bands = suspects[start : start + 64]
        low, high = least[:, bands], most[:, bands]
        padded = [np.pad(side, ((half, half), (0, 0)), mode="symmetric") for side in (low, high)]
        windows = [np.lib.stride_tricks.sliding_window_view(side, width, axis=0) for side in padded]
        # Not the extremes of the neighbours: several of them may be dead, too.
        usual_low = np.partition(np.nan_to_num(windows[0], nan=0.0), width // 3, axis=-1)[..., width // 3]
        usual_high = np.partition(np.nan_to_num(windows[1], nan=0.0), width - 1 - width // 3, axis=-1)
        usual_high = usual_high[..., width - 1 - width // 3]
        hot = (low > _HOT * usual_high) & (low > bright)
        stuck = (low == 0) & (high == 0) & (usual_low > 0)
        full = (low == high) & (low >= largest) & (usual_low < low)
        dead[:, bands] = hot | stuck | full
    return dead if dead.any() else None


def clip_level(values: Array, dtype: np.dtype, ceiling: float | None) -> float | None:
    """The stored value at which the sensor clips; None where nothing tells.

    The lowest of: a plateau (more values on one than in the whole hundredth below it, and next to none above), the
    full scale of 10, 12 and 14 bits where values lie on it, a ``ceiling`` that the file names and no value exceeds,
    the integer type's own largest value.
    """
    levels: list[float] = []
    finite = values[np.isfinite(values)]
    whole = dtype.kind in "iu"
    if not whole and finite.size and float(np.ptp(finite)) == 0:  # an ideal white frame, which no sensor recorded
        finite = finite[:0]
    if whole:
        levels.append(float(np.iinfo(dtype).max))
        finite = finite[finite < levels[0]]
    if not finite.size:
        return min(levels, default=None)
    if ceiling is not None and float(finite.max()) <= ceiling:
        levels.append(ceiling)
    few = max(int(_MOST_STUCK * finite.size), 1)
    top = finite[finite >= np.partition(finite, finite.size - few)[finite.size - few]]
    found, counts = np.unique(top, return_counts=True)
    near = np.sort(finite[finite >= found[0] - max(abs(found[0]) * _TOP_SHARE, 1.0)])
    above = np.cumsum(counts[::-1])[::-1] - counts
    for level, at, over in zip(found[::-1].tolist(), counts[::-1].tolist(), above[::-1].tolist(), strict=True):
        full_scale = whole and level in _FULL_SCALES and at > 1
        if level <= 0 or (at < _LEAST_PLATEAU and not full_scale):
            continue
        depth = max(level * _TOP_SHARE, 1.0) if whole else level * _TOP_SHARE  # of few grey levels the next must count
        below = int(np.searchsorted(near, level) - np.searchsorted(near, level - depth))
        if over == 0:
            plateau = at > below
        else:
            plateau = at >= _LEAST_PLATEAU_BELOW and at > 5 * below and at > over
        if plateau or (full_scale and at * 2 > below and over < at):
            levels.append(level)
            break
    return min(levels, default=None)


def saturated_share(spectra: Array, level: Array | None) -> float:
    """Share of the spectra (n, cols, bands) with a value at or above ``level``, which broadcasts to (cols, bands)."""
    if level is None or not spectra.size:
        return 0.0
    with np.errstate(invalid="ignore"):
        return float((spectra >= level).any(-1).mean())
