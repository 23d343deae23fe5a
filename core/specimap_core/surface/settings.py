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
    """One round: the farthest offset ``reach_voxels`` and how many ``steps`` are tried; ``rounds`` of averaging over
    neighbours, which make the window that is compared; ``surroundings_voxels`` and ``blur_voxels``: the Gaussians of
    the photos' local contrast and of what they are blurred by; ``finer``: the edges are halved first; ``choose_views``:
    photos are chosen anew."""

    reach_voxels: float
    steps: int
    rounds: int
    surroundings_voxels: float
    blur_voxels: float = 0.0
    finer: bool = False
    choose_views: bool = False


@dataclass(frozen=True)
class RefineSettings:
    """Photo-consistent refinement.

    ``passes``: the rounds, in which up to ``views`` photos are compared that see a place at more than
    ``least_cosine``. ``least_score``: correlation below which a vertex follows its neighbours. ``slope`` and ``bend``:
    weights of neighbours that are moved by as much, and by what lies in their middle. ``start_rounds``: rounds of
    smoothing before all else, since neighbours that stand apart by noise are not at their best at one offset;
    ``direction_rounds``: of the directions along which vertices move, for the same reason.
    """

    passes: tuple[Pass, ...] = (
        Pass(2.0, 11, 4, 1.7, blur_voxels=0.25, choose_views=True),
        Pass(1.5, 9, 3, 1.7, blur_voxels=0.25),
        Pass(1.2, 9, 6, 0.65, finer=True, choose_views=True),
        Pass(0.5, 5, 4, 0.65),
    )
    views: int = 16
    least_cosine: float = 0.3
    least_score: float = 0.15
    slope: float = 0.1
    bend: float = 20.0
    start_rounds: int = 4
    direction_rounds: int = 4
