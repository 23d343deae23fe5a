"""The settings of registration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Method = Literal["camera", "homography"]


@dataclass(frozen=True)
class RegisterSettings:
    """``method``: ``camera`` or ``homography``. ``ransac_px``: inlier distance on the coarse grid, as published."""

    method: Method = "camera"
    ransac_px: float = 3.0
