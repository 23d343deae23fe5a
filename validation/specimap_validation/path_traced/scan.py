"""A push-broom camera on a stage of uneven speed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.pushbroom import ScanView


@dataclass(frozen=True)
class UnevenScan(ScanView):
    """A push-broom camera whose rays start where an uneven stage has brought it; it projects as an even one does.

    ``drift``: relative change of the speed from the first line to the last. ``early_px``: how far each line is early.
    """

    drift: float = 0.0
    early_px: tuple[float, ...] = ()

    def origins(self, pixels: Floats) -> Floats:
        """Where the rays of pixels (..., 2) start, mm: (..., 3). A line is one exposure: its rows share its place."""
        uneven = np.array(pixels, float)
        lines = len(self.early_px)
        line = uneven[..., self.along]
        share = line / (lines - 1) - 0.5
        early = np.array(self.early_px)[np.clip(np.rint(line), 0, lines - 1).astype(int)]
        # Mean zero over the scan: what a constant shift and a constant speed would take up is left out.
        uneven[..., self.along] = line + self.drift * lines / 2 * (share**2 - 1 / 12) + early
        return super().origins(uneven)
