"""Match tiles of an image in another that shows them by other channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from specimap_core.arrays import Floats

LEAST_ALONG, LEAST_TILES = 3, 5
"""A small specimen gets smaller tiles, so that there are several; with fewer their scatter says nothing."""
LEAST_COVERED = 0.4
RIDGE = 0.05


@dataclass(frozen=True)
class Tiles:
    """``corner`` (T, 2) row, column of square tiles of ``side`` px; ``mask`` (T, side, side); ``centres`` (T, 2)
    x, y px about their common middle; the image is searched ``reach`` px to all sides."""

    corner: NDArray[np.int64]
    mask: NDArray[np.bool_]
    centres: Floats
    side: int
    reach: int

    @staticmethod
    def of(specimen: NDArray[np.bool_], side_px: float, reach_px: float) -> Tiles | None:
        """Tiles over the specimen; None where too few fit."""
        rows, cols = np.nonzero(specimen)
        low, high = np.array([rows.min(), cols.min()]), np.array([rows.max(), cols.max()]) + 1
        counts = np.maximum(np.round((high - low) / side_px), LEAST_ALONG).astype(int)
        side = int(np.ceil(((high - low) / counts).max()))
        corner, mask, centres = [], [], []
        padded = np.pad(specimen, ((0, side), (0, side)))
        for r in np.linspace(low[0], high[0] - side, counts[0]).round().astype(int):
            for c in np.linspace(low[1], high[1] - side, counts[1]).round().astype(int):
                r, c = max(int(r), 0), max(int(c), 0)
                inside = padded[r : r + side, c : c + side]
                if inside.mean() > LEAST_COVERED:
                    y, x = np.nonzero(inside)
                    corner.append((r, c))
                    mask.append(inside)
                    centres.append((c + x.mean(), r + y.mean()))
        if len(corner) < LEAST_TILES:
            return None
        middle = np.array(centres)
        return Tiles(np.array(corner), np.stack(mask), middle - middle.mean(0), side, int(np.ceil(reach_px)))

    def scores(
        self, channels: NDArray[np.float32], image: NDArray[np.float32], box: tuple[int, int, int, int]
    ) -> NDArray[np.float32]:
        """Share of the image's variance that each tile explains at each shift: (T, n, n), n = 2 reach + 1; row and
        column grow with the shift in y and x. The tiles lie within ``box`` of the image."""
        side, reach = self.side, self.reach
        n = 2 * reach + 1
        span = side + 2 * reach
        size = fft.next_fast_len(span, real=True)
        around = np.pad(image, reach + side)
        there = np.pad(channels, ((0, 0), (0, side), (0, side)))
        patch = np.zeros((len(self.corner), 2, size, size), np.float32)
        tile = np.zeros((len(self.corner), len(channels) + 1, size, size), np.float32)
        inverse = []
        for t, (r, c) in enumerate(self.corner):
            y, x = r + box[0] + side, c + box[2] + side
            found = around[y : y + span, x : x + span]
            patch[t, 0, :span, :span], patch[t, 1, :span, :span] = found, found**2
            mask = self.mask[t]
            values = there[:, r : r + side, c : c + side][:, mask]
            values = values - values.mean(1, keepdims=True)
            tile[t, 0, :side, :side] = mask
            tile[t, 1:, :side, :side][:, mask] = values
            products = values @ values.T
            # A ridge: channels that hardly vary in this tile do not explain anything by amplified noise.
            ridge = RIDGE * float(np.trace(products)) / len(channels) + 1e-12
            inverse.append(np.linalg.inv(products + np.eye(len(channels)) * ridge))
        spectrum = fft.rfft2(patch)
        kernel = np.conj(fft.rfft2(tile))
        mixed = fft.irfft2(kernel * spectrum[:, :1], s=(size, size))[..., :n, :n]
        power = fft.irfft2(kernel[:, 0] * spectrum[:, 1], s=(size, size))[..., :n, :n]
        area = self.mask.sum((1, 2))[:, None, None]
        spread = np.maximum(power - mixed[:, 0] ** 2 / area, max(1e-6 * float(power.max()), 1e-12))
        explained = np.einsum("tkyx,tkl,tlyx->tyx", mixed[:, 1:], np.array(inverse, np.float32), mixed[:, 1:])
        return np.asarray(np.clip(explained / spread, 0, 1), np.float32)
