"""Figures that Bicchi et al. (2026) state of their method: one A100, two specimens."""

from __future__ import annotations

REFERENCE = "Bicchi et al. (2026)"
CORNER_2D_MM = ((0.017, 0.009), (0.013, 0.003))
"""2D corner error of each specimen: mean and standard deviation, mm."""
CORNER_3D_MM = (0.945, 0.974)
"""Median 3D corner error of each specimen, mm."""
RECONSTRUCT_SECONDS = (178.0, 210.0)
REGISTER_SECONDS = (24.0, 25.0)
TOTAL_SECONDS = (202.0, 234.0)
DROPPED_SHARE = 90
"""Percent of the views from which on downwards the 3D corner error passes ``DROPPED_3D_MM``."""
DROPPED_3D_MM = 5.0


def span(values: tuple[float, ...], digits: int) -> str:
    """Least and greatest in words."""
    return f"{min(values):.{digits}f}-{max(values):.{digits}f}"


CORNER_2D_WORDS = span(tuple(mean for mean, _ in CORNER_2D_MM), 3)
CORNER_3D_WORDS = span(CORNER_3D_MM, 3)
STAGE_SECONDS_WORDS = {"reconstruct": span(RECONSTRUCT_SECONDS, 0), "register": span(REGISTER_SECONDS, 0)}
