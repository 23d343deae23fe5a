"""What Bicchi et al. (2026) state of their method, on one A100 and two specimens."""

from __future__ import annotations

STAGE_SECONDS = {"reconstruct": "178-210", "register": "24-25"}
CORNER_2D_MM = "0.013-0.017"
CORNER_3D_MM = "0.945-0.974"
