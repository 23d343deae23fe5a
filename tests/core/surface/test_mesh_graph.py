"""A mesh's vertices and their neighbours: means, smoothing, borders, halved edges."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from specimap_core.surface.mesh_graph import (
    averaged,
    edges_between,
    open_vertices,
    smoothed,
    subdivided,
    unit_averaged,
)

SIDE = 21


def square(side: int = SIDE) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Places (side^2, 2) and triangles of a square grid."""
    x, y = (v.ravel().astype(float) for v in np.meshgrid(np.arange(side), np.arange(side)))
    first = (side * np.arange(side - 1)[:, None] + np.arange(side - 1)).ravel()
    triangles = np.concatenate(
        [np.stack([first, first + 1, first + side + 1], 1), np.stack([first, first + side + 1, first + side], 1)]
    )
    return np.stack([x, y], 1), triangles.astype(np.int32)


def areas(places: NDArray[np.float64], triangles: NDArray[np.int32]) -> NDArray[np.float64]:
    """Signed areas (T,)."""
    a, b, c = (places[triangles[:, k]] for k in range(3))
    u, v = b - a, c - a
    return np.asarray((u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2)


def test_the_border_of_a_square_is_its_border() -> None:
    places, triangles = square()
    border = ((places == 0) | (places == SIDE - 1)).any(1)
    assert np.array_equal(open_vertices(triangles, len(places)), border)


def test_halved_edges_make_four_triangles_of_one() -> None:
    places, triangles = square()
    finer, between = subdivided(triangles, np.ones(len(places), bool))
    assert len(finer) == 4 * len(triangles)
    assert len(between) == edges_between(triangles, len(places)).nnz // 2
    every = np.concatenate([places, places[between].mean(1)])
    assert areas(every, finer) == pytest.approx(1 / 8)


@pytest.mark.parametrize("seed", range(5))
def test_a_partly_halved_mesh_has_no_gaps(seed: int) -> None:
    places, triangles = square()
    which = np.random.default_rng(seed).random(len(places)) < 0.5
    finer, between = subdivided(triangles, which)
    assert which[between].all()
    every = np.concatenate([places, places[between].mean(1)])
    size = areas(every, finer)
    assert (size > 0).all()
    assert size.sum() == pytest.approx((SIDE - 1) ** 2)
    # A gap would be a border inside.
    border = ((every == 0) | (every == SIDE - 1)).any(1)
    assert np.array_equal(open_vertices(finer, len(every)), border)


def test_nothing_finer_leaves_the_triangles() -> None:
    places, triangles = square()
    finer, between = subdivided(triangles, np.zeros(len(places), bool))
    assert np.array_equal(finer, triangles)
    assert between.shape == (0, 2)


def test_averages_keep_what_is_even_and_spread_what_is_not() -> None:
    places, triangles = square()
    edges = edges_between(triangles, len(places))
    assert averaged(np.full((len(places), 2), 3.0, np.float32), edges, 5) == pytest.approx(3.0, rel=1e-5)
    spot = np.zeros((len(places), 1), np.float32)
    middle = len(places) // 2
    spot[middle] = 1
    once, often = averaged(spot, edges, 1)[:, 0], averaged(spot, edges, 6)[:, 0]
    assert (once > 0).sum() == 7
    assert once[middle] == pytest.approx(1 / (1 + 0.5 * 6))
    assert often.argmax() == middle
    assert often.max() < once.max()


def test_averaged_directions_are_unit_vectors_nearer_to_each_other() -> None:
    places, triangles = square()
    edges = edges_between(triangles, len(places))
    noisy = np.random.default_rng(0).normal((0, 0, 1), 0.2, (len(places), 3))
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    calm = unit_averaged(noisy, edges, 3)
    assert np.linalg.norm(calm, axis=1) == pytest.approx(1)
    assert calm[:, :2].std() < noisy[:, :2].std() / 2


def test_smoothing_fills_a_slope_and_takes_noise_away() -> None:
    places, triangles = square()
    edges = edges_between(triangles, len(places))
    rng = np.random.default_rng(1)
    true = 0.1 * places[:, 0]
    weights = (rng.random(len(places)) < 0.7).astype(float)
    noisy = true + rng.normal(0, 0.1, len(places))
    found = smoothed(noisy, weights, edges, 0.02, 20.0)
    inner = ~open_vertices(triangles, len(places))
    off = np.abs(found - true)[inner]
    assert 0.001 < off.mean() < np.abs(noisy - true)[inner].mean() / 2
    assert np.abs(found - true)[inner & (weights == 0)].max() < 0.25
    assert smoothed(noisy, np.ones(len(places)), edges, 0.0, 0.0) == pytest.approx(noisy, abs=1e-3)
