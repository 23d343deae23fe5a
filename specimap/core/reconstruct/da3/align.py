"""Scale for a network's depth: fitted to places whose true depth is known.

The network's depth d of one view is right up to a scale, and at times a shift of its inverse: 1 / z = a / d + b.
With z known, ``z (a / d + b) = 1`` is linear in a and b, and its residual is the share by which the depth is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from specimap.core.geometry import Floats
from specimap.core.reconstruct.depth import Singles

TRIALS = 300
NEAR = 0.015
"""Share of the depth within which a place supports a trial: 2 mm at 150 mm."""
LEAST_PLACES = 12
LEAST_SHARE = 0.5
LARGEST_SCATTER = 0.03
"""A view whose depth scatters more than this share about what is known is not used: 4.5 mm at 150 mm."""
LEAST_TOLD = 0.5
"""Nor is one that scatters more than this share of how the known depths differ: a flat guess would do as well."""
SHIFT_GAIN = 0.8
"""A shift must bring the scatter below this share of what the scale alone leaves."""
SHIFT_SPREAD = 0.05
"""Known depths must differ by this share of their middle for a shift to be told from a scale."""
REACH = 0.025
"""Sd of the kernel that spreads what known places show, as a share of the picture's longer side: 2 mm on a specimen."""
DOUBT = 3.0
"""As many places as this that show no error are added everywhere."""
ROUNDS = 20
TUKEY = 4.685
SIGMA_OF_MAD = 1.4826
LEAST_SIGMA = 1e-4


@dataclass(frozen=True)
class Alignment:
    """``1 / z = a / d + b``: ``z`` mm, ``d`` the network's depth.

    ``scatter``: one standard deviation of what it leaves, as a share of the depth; ``places``: known places that
    agree, of ``of``.
    """

    a: float
    b: float
    scatter: float
    places: int
    of: int

    def apply(self, depth: Singles) -> Singles:
        """Network depth (H, W) to mm; 0 where it was 0, or lies beyond what the shift lets be."""
        d = depth.astype(float)
        inverse = self.a / np.where(d > 0, d, 1) + self.b
        return np.where((d > 0) & (inverse > 0), 1 / np.where(inverse > 0, inverse, 1), 0).astype(np.float32)


def align(network: Floats, true: Floats, *, seed: int = 0) -> Alignment | None:
    """Fit network depths (N,) to true ones (N,) mm; None where they do not fit one another.

    A scale alone, unless a shift explains much more.
    """
    good = np.isfinite(network) & np.isfinite(true) & (network > 0) & (true > 0)
    d, z = network[good].astype(float), true[good].astype(float)
    if len(d) < LEAST_PLACES:
        return None
    # Divided by their middles, both unknowns are of the order of one.
    unit = float(np.median(d)), float(np.median(z))
    rows = np.stack([(z / unit[1]) / (d / unit[0]), z / unit[1]], 1)
    rng = np.random.default_rng(seed)
    fits = [_robust(rows[:, :terms], rng) for terms in (1, 2)]
    spread = float(np.subtract(*np.percentile(z, [95, 5]))) / unit[1]
    with_shift = (
        spread > SHIFT_SPREAD and fits[1][1] < SHIFT_GAIN * fits[0][1] and fits[1][2].sum() >= fits[0][2].sum()
    )
    unknowns, scatter, near = fits[int(with_shift)]
    a = float(unknowns[0]) * unit[0] / unit[1]
    b = float(unknowns[1]) / unit[1] if with_shift else 0.0
    flat = SIGMA_OF_MAD * float(np.median(np.abs(z / unit[1] - 1)))
    if a <= 0 or near.sum() < max(LEAST_PLACES, LEAST_SHARE * len(d)):
        return None
    if scatter > min(LARGEST_SCATTER, LEAST_TOLD * flat):
        return None
    return Alignment(a, b, scatter, int(near.sum()), len(d))


def bend(depth: Singles, at: Floats, true: Floats) -> tuple[Singles, float]:
    """Aligned depth (H, W) mm drawn to true depths (N,) mm at pixels (N, 2), and the scatter that is left.

    A network's error changes slowly over the picture. Its share of the depth, as the known places show it, is averaged
    over :data:`REACH` of the picture and taken off; where no place is known nothing changes.
    """
    found = map_coordinates(depth, at[:, ::-1].T, order=1, mode="nearest")
    known = found > 0
    column, row = np.rint(at[known]).astype(int).T
    off = true[known] / found[known] - 1
    reach = REACH * max(depth.shape)
    if not len(off):
        return depth.copy(), np.inf
    # A poor network is off by more than what tells false matches from true ones about a good one.
    near = np.abs(off) < max(2 * NEAR, 3 * SIGMA_OF_MAD * float(np.median(np.abs(off))))
    total, count = (np.zeros(depth.shape) for _ in range(2))
    np.add.at(total, (row[near], column[near]), off[near])
    np.add.at(count, (row[near], column[near]), 1.0)
    # Times the kernel's area, the smoothed count is the number of places within reach.
    area = 2 * np.pi * reach**2
    total, count = (area * gaussian_filter(v, reach, mode="constant") for v in (total, count))
    field = total / (count + DOUBT)
    scatter = SIGMA_OF_MAD * float(np.median(np.abs(off - field[row, column])[near]))
    return (depth * (1 + field)).astype(np.float32), scatter


def _robust(rows: Floats, rng: np.random.Generator) -> tuple[Floats, float, NDArray[np.bool_]]:
    """Unknowns x of ``rows @ x = 1``, the scatter of what supports them, and which rows (N,) do.

    The best of random least sets, then least squares reweighted by Tukey's biweight.
    """
    n, terms = rows.shape
    picks = rng.integers(0, n, (TRIALS, terms))
    sets = rows[picks]
    regular = np.abs(np.linalg.det(sets)) > 1e-9
    if not regular.any():
        return np.zeros(terms), np.inf, np.zeros(n, bool)
    trials = np.linalg.solve(sets[regular], np.ones((int(regular.sum()), terms, 1)))[..., 0]
    off = np.abs(trials @ rows.T - 1)
    x = trials[np.minimum(off, NEAR).sum(1).argmin()]
    for _ in range(ROUNDS):
        r = rows @ x - 1
        near = np.abs(r) < 2 * NEAR
        sigma = max(SIGMA_OF_MAD * float(np.median(np.abs(r[near]))) if near.any() else NEAR, LEAST_SIGMA)
        weight = np.clip(1 - (r / (TUKEY * sigma)) ** 2, 0, None)
        left = rows * weight[:, None]
        moved = np.linalg.lstsq(left, weight, rcond=None)[0]
        done = float(np.abs(moved - x).max()) < 1e-9
        x = moved
        if done:
            break
    r = rows @ x - 1
    near = np.abs(r) < 2 * NEAR
    scatter = SIGMA_OF_MAD * float(np.median(np.abs(r[near]))) if near.any() else np.inf
    return x, scatter, near
