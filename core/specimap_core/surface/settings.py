"""The settings of fusion and refinement."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SurfaceSettings:
    """Fusion.

    ``voxel_mm``: edge of a voxel; by default twice a photo's pixel on the specimen, which is 0.3 mm for photos of
    512 pixels that show the layout. ``truncation_voxels``: reach of a depth on either side. ``least_weight``:
    depths that must agree on a voxel. ``smallest_part_share``: connected parts with fewer triangles than this
    share of the largest are dropped.
    """

    voxel_mm: float | None = None
    truncation_voxels: float = 4.0
    least_weight: float = 3.0
    smallest_part_share: float = 0.02


@dataclass(frozen=True)
class Pass:
    """One round: the farthest offset ``reach_voxels``, how many ``steps`` are tried, ``views`` compared;
    ``half_samples``: the patch is (2 n + 1)^2 samples, a photo's pixel apart on the surface; ``keep_views``: compare
    the photos of the round before, which choosing anew would hardly change."""

    reach_voxels: float
    steps: int
    views: int
    half_samples: int = 2
    keep_views: bool = False


@dataclass(frozen=True)
class RefineSettings:
    """Photo-consistent refinement.

    ``passes``: the rounds; the last, on smaller patches, brings out what is narrower than the others'.
    ``least_score``: correlation below which a vertex follows its neighbours. ``smoothness``: weight of the
    neighbours.
    """

    passes: tuple[Pass, ...] = (Pass(2.0, 11, 9), Pass(0.8, 5, 9), Pass(0.5, 5, 9, half_samples=1, keep_views=True))
    least_score: float = 0.3
    smoothness: float = 0.2
    smoothing_rounds: int = 10
    least_cosine: float = 0.25
