"""The settings of the top views."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RenderSettings:
    """``r_reg_mm``: cell of the coarse grid, on which the homography is fitted; ``r_pc_mm``: of the fine grid."""

    r_reg_mm: float = 2.0
    r_pc_mm: float = 0.5
