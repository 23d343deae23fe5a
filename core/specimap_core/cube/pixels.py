"""Sources of a cube's values: an array in memory or on disk, or something decoded as it is read."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cube.strided import Bands, band_mean, native, rows_contiguous, to_bip

# Strips of about this size keep two threads busy and stay near the last-level cache.
STRIP_BYTES = 12 << 20


def workers() -> int:
    """Threads worth starting: the cores this process may use, at most 8."""
    return min(8, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


class Pixels(ABC):
    """Values of a cube by rows. ``shape`` is (rows, cols, bands); ``dtype`` is native."""

    shape: tuple[int, int, int]
    dtype: np.dtype

    @abstractmethod
    def block(self, start: int, stop: int) -> Array:
        """Rows ``start`` to ``stop`` as (n, cols, bands), in any memory and byte order."""

    @abstractmethod
    def band(self, index: int) -> Array:
        """One band (rows, cols), native byte order."""

    def strip_rows(self) -> int:
        """How many rows are best read together."""
        return max(1, STRIP_BYTES // max(1, self.shape[1] * self.shape[2] * self.dtype.itemsize))

    def mean(self, bands: Bands) -> NDArray[np.float32]:
        """Mean over the sorted band indices, (rows, cols), NaN values left out."""
        rows, cols, _ = self.shape
        out = np.empty((rows, cols), np.float32)
        step = self.strip_rows()

        def average(start: int) -> None:
            stop = min(start + step, rows)
            out[start:stop] = band_mean(self.block(start, stop), bands)

        with ThreadPoolExecutor(workers()) as pool:
            list(pool.map(average, range(0, rows, step)))
        return out


class ArrayPixels(Pixels):
    """An array (rows, cols, bands), most often a view of a memory map, of any strides and byte order."""

    def __init__(self, view: Array) -> None:
        rows, cols, bands = view.shape
        self.shape = (rows, cols, bands)
        self.dtype = native(view.dtype)
        # np.asarray: slicing np.memmap objects costs more than the read itself for single rows.
        self._view = np.asarray(view)

    def block(self, start: int, stop: int) -> Array:
        return self._view[start:stop]

    def band(self, index: int) -> Array:
        return np.ascontiguousarray(self._view[:, :, index], self.dtype)

    def mean(self, bands: Bands) -> NDArray[np.float32]:
        if rows_contiguous(self._view):
            turned = ArrayPixels(self._view.transpose(1, 0, 2))
            return np.ascontiguousarray(turned.mean(bands).T)
        return super().mean(bands)


def read_bip(pixels: Pixels, start: int, stop: int) -> Array:
    """Rows as a C-contiguous (n, cols, bands) array in native byte order."""
    return to_bip(pixels.block(start, stop))


def sampled_rows(rows: int, most: int) -> list[int]:
    """At most ``most`` row indices spread evenly over the cube."""
    count = min(rows, most)
    return [int((i + 0.5) * rows / count) for i in range(count)]
