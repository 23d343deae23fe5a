"""Find the pixels inside a polygon: even-odd rule, many pixels and edges at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array

_ROW_STEP = 2.0**18
"""Distance between rows in a key; beyond any column, with 18 bits of a double left for its fraction."""


def in_outline(pixels: NDArray[np.uint16], outline: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether the centres of pixels (n, 2) row, column lie in the closed polygon (m, 2); (n,).

    A centre on the outline, within 1e-5 pixels, lies inside.
    """
    keys = pixels[:, 0] * _ROW_STEP + pixels[:, 1]
    if not len(keys):
        return np.zeros(0, bool)
    rows = int(pixels[:, 0].min()), int(pixels[:, 0].max())
    # An edge takes part in the rows from its upper end to before its lower one, or the other way round: each rule
    # misses some tips of the polygon, both together none.
    inside = [_inside(keys, _crossings(outline, rows, upper=upper)) for upper in (True, False)]
    return inside[0] | inside[1] | _on_level_edges(keys, outline)


def rows_crossed(outline: NDArray[np.float64], last_row: int) -> int:
    """How many rows of pixels up to ``last_row`` the edges of a closed polygon (m, 2) cross, all together.

    What :func:`in_outline` takes of time and memory grows with it.
    """
    rows = np.clip(outline[:, 0], -1, last_row + 1)
    return int(np.abs(np.diff(rows, append=rows[:1])).sum())


def _inside(keys: Array, crossings: Array) -> NDArray[np.bool_]:
    # Each row has an even number of crossings, so that those of the rows before do not change whether a count is odd.
    left, right = np.searchsorted(crossings, keys, "left"), np.searchsorted(crossings, keys, "right")
    return np.asarray((left % 2 == 1) | (left != right))


def _on_level_edges(keys: Array, outline: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which pixels lie on an edge along a row; such an edge crosses none."""
    other = np.roll(outline, -1, axis=0)
    level = (outline[:, 0] == other[:, 0]) & (outline[:, 0] == np.rint(outline[:, 0]))
    row, cols = outline[level, 0] * _ROW_STEP, np.stack([outline[level, 1], other[level, 1]])
    begun = np.searchsorted(np.sort(row + cols.min(0)), keys, "right")
    ended = np.searchsorted(np.sort(row + cols.max(0)), keys, "left")
    return np.asarray(begun > ended)


def _crossings(outline: NDArray[np.float64], rows: tuple[int, int], *, upper: bool) -> Array:
    """Sorted keys of where the edges cross the rows."""
    a, b = outline, np.roll(outline, -1, axis=0)
    low, high = np.minimum(a[:, 0], b[:, 0]), np.maximum(a[:, 0], b[:, 0])
    ends = (np.ceil(low), np.ceil(high)) if upper else (np.floor(low) + 1, np.floor(high) + 1)
    first, stop = (np.clip(end, rows[0], rows[1] + 1).astype(np.intp) for end in ends)
    count = stop - first
    edge = np.repeat(np.arange(len(outline)), count)
    row = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    (row_a, col_a), (row_b, col_b) = a[edge].T, b[edge].T
    col = col_a + (row - row_a) / (row_b - row_a) * (col_b - col_a)
    # Rounded, so that a crossing computed to lie next to a centre that it meets does meet it.
    col = np.rint(np.clip(col, -1, _ROW_STEP / 2) * 2**17) / 2**17
    return np.sort(row * _ROW_STEP + col)
