"""Scale for a network's depth: fitted to places whose true depth is known, such as those on the markers.

The network's depth d of one view is right up to a scale, and at times a shift of its inverse: 1 / z = a / d + b.
With z known, ``z (a / d + b) = 1`` is linear in a and b, and its residual is the share by which the depth is off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from specimap_core.arrays import Floats, Singles
from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import View
from specimap_core.geometry.robust import SIGMA_OF_MAD

MARKER_STEPS = 6
"""Known places along a marker's edge: about as many on four markers as features on a specimen."""
MARKER_INSET = 0.08
"""Share of the edge left out: the network rounds the card's border."""
TRIALS = 300
NEAR = 0.015
"""Share of the depth within which a place supports a trial: 2 mm at 150 mm."""
LEAST_PLACES = 12
LEAST_SHARE = 0.5
LARGEST_SCATTER = 0.03
"""A view whose depth scatters more than this share about what is known is not used: 4.5 mm at 150 mm."""
LEAST_EXPLAINED = 0.5
"""Nor is one that scatters more than this share of how the known depths differ: a flat guess would do as well."""
SHIFT_GAIN = 0.8
"""A shift must bring the scatter below this share of what the scale alone leaves."""
SHIFT_SPREAD = 0.05
"""Known depths must differ by this share of their middle for a shift to be distinguished from a scale."""
ROUNDS = 20
TUKEY = 4.685
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


def depths_at(points: Floats, view: View, network: Singles) -> tuple[Floats, Floats, Floats]:
    """Pixels (M, 2), the network's depth and the true one (M,) of those ``points`` (N, 3) mm that lie in the view."""
    cam = view.cam_from_world.apply(points)
    cam = cam[cam[:, 2] > 0]
    at = view.intrinsics.project(cam)
    height, width = network.shape
    inside = (at >= 0).all(1) & (at[:, 0] <= width - 1) & (at[:, 1] <= height - 1)
    found = map_coordinates(network, at[inside, ::-1].T, order=1, mode="nearest")
    return at[inside], np.asarray(found, float), cam[inside, 2]


def on_markers(corners: Floats, seen: Observations, photo: int) -> Floats:
    """Places (N, 3) mm inside the markers that a photo shows; ``corners`` (Q, 4, 3) by ``seen.marker``."""
    steps = np.linspace(MARKER_INSET, 1 - MARKER_INSET, MARKER_STEPS)
    u, v = (g.ravel()[:, None] for g in np.meshgrid(steps, steps))
    weights = np.concatenate([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v], 1)
    shown = np.unique(seen.marker[seen.photo == photo])
    return np.asarray(weights @ corners[shown]).reshape(-1, 3)


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
    with_shift = spread > SHIFT_SPREAD and fits[1][1] < SHIFT_GAIN * fits[0][1] and fits[1][2].sum() >= fits[0][2].sum()
    unknowns, scatter, near = fits[int(with_shift)]
    a = float(unknowns[0]) * unit[0] / unit[1]
    b = float(unknowns[1]) / unit[1] if with_shift else 0.0
    flat = SIGMA_OF_MAD * float(np.median(np.abs(z / unit[1] - 1)))
    if a <= 0 or near.sum() < max(LEAST_PLACES, LEAST_SHARE * len(d)):
        return None
    if scatter > min(LARGEST_SCATTER, LEAST_EXPLAINED * flat):
        return None
    return Alignment(a, b, scatter, int(near.sum()), len(d))


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
