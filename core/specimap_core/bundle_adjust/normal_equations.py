"""Normal equations of a bundle adjustment: put together from blocks, and solved by the Schur complement (Brown 1958).

No measurement ties two photos to each other, so their blocks on the diagonal stand alone and are inverted one by one;
what is left to solve has the size of the lens and the markers, however many photos there are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats

LEAST_DAMPING = 1e-12
"""Added to the diagonal, so that an unknown that nothing determines stays where it is."""


class Assembly:
    """Adds up the blocks of M observations, each of which bears on K of N unknowns: ``columns`` (M, K)."""

    def __init__(self, columns: NDArray[np.int64], unknowns: int) -> None:
        self._columns, self._unknowns = columns.ravel(), unknowns
        self._cells = (columns[:, :, None] * unknowns + columns[:, None, :]).ravel()

    def __call__(self, J: Floats, r: Floats) -> tuple[Floats, Floats]:
        """Normal matrix (N, N) and gradient (N,) of weighted derivatives (M, R, K) and residuals (M, R)."""
        across, n = J.transpose(0, 2, 1), self._unknowns
        H = np.bincount(self._cells, (across @ J).ravel(), n * n).reshape(n, n)
        g = np.bincount(self._columns, (across @ r[..., None]).ravel(), n)
        return np.asarray(H, float), np.asarray(g, float)


def damped_step(H: Floats, g: Floats, damping: float, blocks: tuple[int, int, int]) -> Floats:
    """The step x (N,) with ``(H + damping diag(H)) x = -g``, for a symmetric H (N, N).

    ``blocks``: first unknown, number and size of the blocks that stand one after the other on the diagonal and that H
    does not tie to each other. Raises LinAlgError where the equations have no solution.
    """
    first, count, size = blocks
    end = first + count * size
    inner, outer = np.arange(first, end), np.r_[:first, end : len(g)]
    diagonal = damping * np.diag(H) + LEAST_DAMPING
    each = inner.reshape(count, size)
    inverse = np.linalg.inv(H[each[:, :, None], each[:, None, :]] + np.eye(size) * diagonal[each][:, None])
    cross = H[first:end, outer]
    known = np.concatenate([cross, -g[inner, None]], 1).reshape(count, size, -1)
    solved = (inverse @ known).reshape(count * size, -1)
    by_outer, alone = solved[:, :-1], solved[:, -1]
    left = H[np.ix_(outer, outer)] + np.diag(diagonal[outer]) - cross.T @ by_outer
    step = np.empty(len(g))
    step[outer] = np.linalg.solve(left, -g[outer] - cross.T @ alone)
    step[inner] = alone - by_outer @ step[outer]
    return step
