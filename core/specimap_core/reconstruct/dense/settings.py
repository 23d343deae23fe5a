"""The settings that depth is measured with."""

from __future__ import annotations

from dataclasses import dataclass

from specimap_core.geometry.cameras import Intrinsics
from specimap_core.reconstruct.dense.device import Device


@dataclass(frozen=True)
class DepthSettings:
    """Dense matching.

    ``angle_deg``: least, best and widest angle between two photos' directions to the scene. ``wide_angle_deg``:
    the widest angle where a photo has no nearer neighbour. ``pairs_per_photo``: partners of each photo; one
    fewer from ``many_photos`` on, since every place is then seen by more photos anyway. ``block_px``: matching
    window. ``matching_share`` and ``most_matching_px``: photos are matched at this share of their size, and no larger;
    the mesh is refined on the photos as they are, after which it is as good as from full-size matching.
    ``uniqueness``: per cent by which the best match must win. ``device``: no choice any more, but
    a part of the keys of artefacts, see :mod:`specimap_core.reconstruct.dense.device`.
    """

    angle_deg: tuple[float, float, float] = (4.0, 14.0, 30.0)
    wide_angle_deg: float = 42.0
    pairs_per_photo: int = 3
    many_photos: int = 32
    block_px: int = 3
    matching_share: float = 0.6
    most_matching_px: int = 512
    uniqueness: int = 8
    device: Device = "auto"

    def shrinkage(self, lens: Intrinsics) -> float:
        """Factor by which photos of ``lens`` are shrunk before they are matched."""
        return min(self.matching_share, self.most_matching_px / max(lens.width, lens.height))
