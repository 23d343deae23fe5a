"""The marker corners that register a cube: where they lie on the specimen's plane, and where the cube shows them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.bundle_adjust.adjust import Adjusted
from specimap_core.register.cube_markers import CubeMarkers, unmirrored

SIGMA_FLOOR_PX = 0.01
"""Standard deviation that a corner in the cube has at least, whatever its image says."""


@dataclass(frozen=True)
class CornersInCube:
    """``corners`` (Q, 4, 3) mm of ``marker_ids``, their places ``corners_px`` (Q, 4, 2) in the cube, columns as the
    camera saw them, and ``sigma_px`` (Q,). ``covariance`` (12 Q, 12 Q) mm^2 of the corners in space, None where their
    places are known."""

    marker_ids: tuple[int, ...]
    corners: Floats
    corners_px: Floats
    sigma_px: Floats
    covariance: Floats | None = None

    def of(self, keep: NDArray[np.bool_]) -> CornersInCube:
        """Those of the markers in ``keep`` (Q,)."""
        ids = tuple(i for i, kept in zip(self.marker_ids, keep, strict=True) if kept)
        covariance = (
            None if self.covariance is None else self.covariance[np.ix_(np.repeat(keep, 12), np.repeat(keep, 12))]
        )
        return CornersInCube(ids, self.corners[keep], self.corners_px[keep], self.sigma_px[keep], covariance)

    def flat(self, keep: NDArray[np.bool_] | None = None) -> tuple[Floats, Floats, Floats]:
        """Corners (N, 3), pixels (N, 2), sigma (N,) of the markers in ``keep``, of all by default."""
        chosen = slice(None) if keep is None else keep
        return (
            self.corners[chosen].reshape(-1, 3),
            self.corners_px[chosen].reshape(-1, 2),
            np.repeat(self.sigma_px[chosen], 4),
        )


def corners_in_cube(markers: CubeMarkers, adjusted: Adjusted, cols: int) -> CornersInCube:
    """Pair the markers found in a cube of ``cols`` columns with their adjusted corners."""
    rows = [adjusted.marker_ids.index(i) for i in markers.marker_ids]
    at = (12 * np.array(rows)[:, None] + np.arange(12)).ravel()
    return CornersInCube(
        markers.marker_ids,
        adjusted.corners[rows],
        unmirrored(markers.corners_px, markers.mirrored, cols),
        np.hypot(markers.sigma_px, SIGMA_FLOOR_PX),
        adjusted.covariance[np.ix_(at, at)],
    )
