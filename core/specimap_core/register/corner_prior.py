"""Marker corners as a cube's camera sees them, where their own places are known with a covariance.

A corner's residual in the cube is made of two errors: that of its measurement there, and that of its place in space, as
the photos give it. The second is shared by all corners (a scale, a tilt of a card), which a standard deviation of each
corner cannot say. Weighting residuals by the sum of both, and handing the places their part afterwards, is the joint
adjustment of photos and cube with the photos' unknowns eliminated (Brown 1958).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View

LEAST_SIGMA_PX = 1e-3
STEP_MM = 1e-2


@dataclass(frozen=True)
class CornerPrior:
    """N corners seen through a camera.

    ``derivatives`` (N, 2, 3): of a pixel by its corner's place, px/mm; ``covariance`` (3 N, 3 N) mm^2 of the places,
    None where they are known; ``weight`` (2 N, 2 N) 1/px: inverse Cholesky factor of the residuals' covariance.
    """

    derivatives: Floats
    covariance: Floats | None
    weight: Floats

    @staticmethod
    def of(view: View, corners: Floats, sigma_px: Floats, covariance: Floats | None) -> CornerPrior:
        """Corners (N, 3) mm measured with ``sigma_px`` (N,) through ``view``."""
        noise = np.repeat(np.maximum(sigma_px, LEAST_SIGMA_PX), 2)
        if covariance is None:
            return CornerPrior(np.zeros((len(corners), 2, 3)), None, np.diag(1 / noise))
        steps = STEP_MM * np.eye(3)
        derivatives = np.stack(
            [(view.project(corners + step) - view.project(corners - step)) / (2 * STEP_MM) for step in steps], -1
        )
        shared = _seen(derivatives, _seen(derivatives, covariance).T)
        root = np.linalg.cholesky(shared + np.diag(noise**2))
        return CornerPrior(derivatives, covariance, solve_triangular(root, np.eye(len(root)), lower=True))

    def whiten(self, miss: Floats) -> Floats:
        """Residuals (N, 2) px as 2 N independent ones in standard deviations."""
        return np.asarray(self.weight @ miss.ravel())

    def shift(self, miss: Floats, of: Floats | None = None) -> Floats:
        """By how much (N, 3) mm the corners' places move, given residuals ``miss`` (N, 2) of the camera; of other
        places (K, 3) with ``of``, their covariance (3 K, 3 N) with the corners."""
        if self.covariance is None:
            return np.zeros((len(miss), 3))
        weighed = self.weight.T @ self.whiten(miss)
        of = self.covariance if of is None else of
        return np.asarray(-(_seen(self.derivatives, of.T).T @ weighed).reshape(-1, 3))

    def reduced(self, covariance: Floats, of: Floats, by_camera: Floats, camera_weight: Floats) -> Floats:
        """What is left of the ``covariance`` (3 K, 3 K) of places once the cube has shown its corners.

        ``of`` (3 K, 3 N): with the corners; ``by_camera`` (2 N, P): derivatives of the pixels by the camera's P
        unknowns, which the corners have to tell as well, and ``camera_weight`` (P, P): what is known of these before.
        """
        seen = self.weight @ _seen(self.derivatives, of.T)
        camera = self.weight @ by_camera
        taken = camera.T @ seen
        gained = seen.T @ seen - taken.T @ np.linalg.solve(camera.T @ camera + camera_weight, taken)
        return np.asarray(covariance - (gained + gained.T) / 2)

    def seen_shift(self, shift: Floats) -> Floats:
        """What a shift (N, 3) mm of the corners does in the cube, (N, 2) px."""
        return np.asarray((self.derivatives @ shift[..., None])[..., 0])


def _seen(derivatives: Floats, places: Floats) -> Floats:
    """Rows (3 N, K) by place to rows (2 N, K) by pixel."""
    count = len(derivatives)
    return np.asarray((derivatives @ places.reshape(count, 3, -1)).reshape(2 * count, -1))
