"""Seeded band-limited noise: made once by Fourier synthesis, then looked up at any point."""

from __future__ import annotations

import numpy as np
from scipy import fft, ndimage

from specimap_core.arrays import Floats, Singles


def band_noise(
    rng: np.random.Generator, shape: tuple[int, ...], shortest: float, longest: float, slope: float = 1.0
) -> Singles:
    """Periodic Gaussian noise, zero mean, unit sd, of wavelengths from ``shortest`` to ``longest`` cells.

    Amplitude falls as frequency ** -slope. The edges of the band are soft.
    """
    white = rng.standard_normal(shape, dtype=np.float32)
    axes = [np.fft.fftfreq(n) for n in shape[:-1]] + [np.fft.rfftfreq(shape[-1])]
    frequency = np.sqrt(sum(f**2 for f in np.meshgrid(*axes, indexing="ij", sparse=True)))
    safe = np.maximum(frequency, 1e-6)
    gain = safe**-slope * np.exp(-((safe * shortest) ** 4)) * (1 - np.exp(-((safe * longest) ** 4)))
    gain.flat[0] = 0
    noise = fft.irfftn(fft.rfftn(white) * gain.astype(np.float32), s=shape)
    return np.asarray(noise / noise.std(), np.float32)


class NoiseVolume:
    """Noise over 3D space with features of ``shortest_mm`` to ``longest_mm``.

    It repeats only along axes that are turned against the world's, so that no photo shows a grid.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        shortest_mm: float,
        longest_mm: float,
        *,
        size: int = 64,
        slope: float = 1.0,
    ) -> None:
        # Three cells per shortest wavelength are what trilinear lookup renders without visible creases.
        self._cell_mm = shortest_mm / 3
        self._volume = band_noise(rng, (size,) * 3, 3, longest_mm / self._cell_mm, slope)
        self._axes = np.linalg.qr(rng.standard_normal((3, 3)))[0] / self._cell_mm

    def __call__(self, points: Floats | Singles) -> Singles:
        """Values (N,) at points (N, 3) mm."""
        cells = points @ self._axes
        values = ndimage.map_coordinates(self._volume, cells.T, order=1, mode="grid-wrap", output=np.float32)
        return np.asarray(values, np.float32)


def smoothstep(low: float, high: float, x: Floats | Singles) -> Floats:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((x - low) / (high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))
