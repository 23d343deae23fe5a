"""A small cube and cloud points whose truth is known, for the tests of the cloud and its exports."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cloud import CloudPoints


@dataclass(eq=False)
class FakeCube:
    """A cube in memory; ``fails_at``: the row from which reading fails, with ``error``."""

    values: Array
    to_reflectance: float | None = 1e-4
    quantity: str = "reflectance"
    bad: tuple[int, ...] = ()
    saturation: NDArray[np.float64] | None = None
    fails_at: int | None = None
    error: Exception = field(default_factory=lambda: RuntimeError("the cube broke"))

    @property
    def rows(self) -> int:
        return int(self.values.shape[0])

    @property
    def cols(self) -> int:
        return int(self.values.shape[1])

    @property
    def bands(self) -> int:
        return int(self.values.shape[2])

    @property
    def dtype(self) -> np.dtype:
        return self.values.dtype

    @property
    def wavelengths_nm(self) -> NDArray[np.float64]:
        return np.linspace(400, 1000, self.bands)

    @property
    def bad_bands(self) -> NDArray[np.bool_]:
        mask = np.zeros(self.bands, bool)
        mask[list(self.bad)] = True
        return mask

    def read_rows(self, start: int, stop: int) -> Array:
        if self.fails_at is not None and stop > self.fails_at:
            raise self.error
        return self.values[start:stop]


def counts(rows: int = 70, cols: int = 53, bands: int = 7, seed: int = 0) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 60000, (rows, cols, bands), dtype=np.uint16)


def scene(rows: int, cols: int, share: float = 0.8, seed: int = 1) -> CloudPoints:
    """Points of a share of the pixels, shuffled, on a bumpy surface of 0.1 mm a pixel."""
    rng = np.random.default_rng(seed)
    row, col = np.nonzero(rng.random((rows, cols)) < share)
    order = rng.permutation(len(row))
    row, col = row[order], col[order]
    n = len(row)
    z = 2 * np.sin(row / 9) * np.cos(col / 7)
    normal = rng.normal(size=(n, 3))
    return CloudPoints(
        hsi_pixel=np.stack([row, col], 1).astype(np.uint16),
        xyz=np.stack([col * 0.1, -row * 0.1, z], 1).astype(np.float32),
        normal=(normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32),
        rgb=rng.integers(0, 256, (n, 3), dtype=np.uint8),
        sigma_mm=rng.random(n).astype(np.float32),
        flags=rng.choice(np.array([1, 2, 5], np.uint8), n),
    )
