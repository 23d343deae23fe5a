"""What the vertices of a mesh make of their neighbours: means over edges, smoothing, finer triangles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import cg

from specimap_core.arrays import Floats, Ints, Singles

TOLERANCE = 0.01
"""Of what is smoothed: a hundredth of offsets that are tenths of a voxel."""
MOST_ITERATIONS = 80
STAY = 1e-5
"""Weight of staying where nothing else says anything."""


def edges_between(triangles: NDArray[np.int32], n: int) -> csr_array:
    """Which of ``n`` vertices share an edge, (n, n), 1 where they do."""
    a, b = triangles[:, [0, 1, 2]].ravel(), triangles[:, [1, 2, 0]].ravel()
    edges = coo_array((np.ones(2 * len(a), np.float32), (np.r_[a, b], np.r_[b, a])), shape=(n, n)).tocsr()
    edges.data[:] = 1.0
    return edges


def open_vertices(triangles: NDArray[np.int32], n: int) -> NDArray[np.bool_]:
    """Which of ``n`` vertices lie on a border of the mesh: on an edge of only one triangle."""
    ends = np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1).astype(np.int64)
    key, count = np.unique(ends[:, 0] * n + ends[:, 1], return_counts=True)
    found = np.zeros(n, bool)
    found[key[count == 1] // n] = found[key[count == 1] % n] = True
    return found


def averaged(values: Singles, edges: csr_array, rounds: int, share: float = 0.5) -> Singles:
    """Values (n, k) averaged over the surroundings: in each round a vertex counts 1, each neighbour ``share``."""
    degree = np.asarray(edges.sum(1), np.float32).ravel()
    mix = diags_array(1 / (1 + share * degree)) @ (share * edges + diags_array(np.ones_like(degree)))
    mix = csr_array(mix, dtype=np.float32)
    for _ in range(rounds):
        values = mix @ values
    return np.asarray(values, np.float32)


def unit_averaged(vectors: Floats, edges: csr_array, rounds: int) -> Floats:
    """Unit vectors (n, 3), averaged over the surroundings."""
    for _ in range(rounds):
        vectors = vectors + edges @ vectors
        vectors = vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)
    return np.asarray(vectors)


def smoothed(values: Floats, weights: Floats, edges: csr_array, slope: float, bend: float) -> Floats:
    """What minimises, over all n vertices, ``weights`` times the squared difference to ``values``, plus ``slope``
    times the squared differences between neighbours, plus ``bend`` times the squared differences to their mean."""
    degree = np.maximum(np.asarray(edges.sum(1), np.float32).ravel(), 1)
    laplacian = diags_array(degree) - edges
    away = diags_array(1 / degree) @ laplacian
    matrix = diags_array((weights + STAY).astype(np.float32)) + np.float32(slope) * laplacian
    matrix = csr_array(matrix + np.float32(bend) * (away.T @ away), dtype=np.float32)
    target = (weights * values).astype(np.float32)
    start = np.where(weights > 0, values, 0.0).astype(np.float32)
    inverse = diags_array(1 / matrix.diagonal())
    # The next pass starts from what this one leaves, so that more iterations than these buy nothing.
    found, _ = cg(matrix, target, x0=start, rtol=TOLERANCE, maxiter=MOST_ITERATIONS, M=inverse)
    return np.asarray(found, float)


def subdivided(triangles: NDArray[np.int32], finer: NDArray[np.bool_]) -> tuple[NDArray[np.int32], Ints]:
    """Triangles (T', 3) of a mesh in which every edge between two ``finer`` (V,) vertices has a new one in its middle,
    and the pair (E, 2) of vertices that each new one lies between; the first new one is number V."""
    n = len(finer)
    ends = triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
    split = finer[ends].all(1)
    ends = np.sort(ends, axis=1)
    keys, number = np.unique(ends[split, 0] * n + ends[split, 1], return_inverse=True)
    new = np.full(len(ends), -1, np.int64)
    new[split] = n + number
    middle = new.reshape(-1, 3)
    # Three ends that are finer split all three edges, two split the one between them.
    whole, one = (middle >= 0).all(1), (middle >= 0).sum(1) == 1
    corners, between = triangles[whole], middle[whole]
    parts = [triangles[~whole & ~one]]
    parts += [np.stack([corners[:, k], between[:, k], between[:, k - 1]], 1) for k in range(3)] + [between]
    k = (middle[one] >= 0).argmax(1)
    rows = np.arange(len(k))
    first, second, third = (triangles[one][rows, (k + j) % 3] for j in range(3))
    added = middle[one][rows, k]
    parts += [np.stack([first, added, third], 1), np.stack([added, second, third], 1)]
    return np.concatenate(parts).astype(np.int32), np.stack([keys // n, keys % n], 1)
