"""Detect a motion of the specimen between photos and cube, by its texture and outline.

The tiles of a :class:`~specimap_core.register.tile_offsets.TileOffsets` give a rigid motion in the image's plane, and
their scatter its uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.register.camera_fitting import SHARED_MM
from specimap_core.register.tile_matching import LEAST_TILES
from specimap_core.register.tile_offsets import TileOffsets, measure_tile_offsets
from specimap_core.surface.raycast import RayCaster

LEAST_AGREE = 0.6
LEAST_MARKERS = 4
"""Three nearly coplanar markers leave the cube's focal length open: raised tissue then seems to have moved."""
ALLOWED_MM = 0.3
ALLOWED_SIGMA = 4.0


@dataclass(frozen=True)
class Shift:
    """Motion of the specimen between photos and cube.

    ``shift_mm`` (2,): of its middle in x and y of the marker frame; ``turn_deg`` about the cube camera's axis,
    counter-clockwise seen from above; ``moved_mm``: root mean square over the specimen of the distance by which its
    parts are off; ``sigma_mm``: one standard deviation of that; ``tiles``: how many parts it rests on.
    """

    shift_mm: tuple[float, float]
    turn_deg: float
    moved_mm: float
    sigma_mm: float
    tiles: int

    @property
    def significant(self) -> bool:
        """Whether it is more than registration allows."""
        return self.moved_mm > max(ALLOWED_MM, ALLOWED_SIGMA * self.sigma_mm)

    @property
    def message(self) -> str:
        """In a sentence."""
        return f"The specimen seems to have moved by about {self.moved_mm:.1f} mm between photos and cube."


def measure_motion(
    image: NDArray[np.float32],
    view: View,
    caster: RayCaster,
    corners: Floats,
    *,
    markers_in_cube: int,
    mirrored: bool = False,
) -> Shift | None:
    """Motion of the specimen; None where :func:`measure_tile_offsets` measures nothing, or where the cube shows too few
    markers to distinguish a motion from a wrong camera."""
    if markers_in_cube < LEAST_MARKERS:
        return None
    measured = measure_tile_offsets(image, view, caster, corners, mirrored=mirrored)
    return None if measured is None else motion_of_tiles(measured)


def motion_of_tiles(measured: TileOffsets) -> Shift | None:
    """The rigid motion that the tiles show; None where they contradict each other."""
    motion = _rigid(measured.centres, measured.offsets, measured.weight, measured.px)
    if motion is None:
        return None
    (dx, dy), turn, moved, sigma, count = motion
    across_mm, down_mm = measured.view.mm_per_px(measured.depth_mm) / measured.scale
    # Image to marker frame: the camera looks down, so that its axes' horizontal parts carry the shift.
    across = measured.view.cam_from_world.R.T @ np.array([dx * across_mm, dy * down_mm, 0.0])
    shift = float(across[0]), float(across[1])
    mm = float(np.sqrt(across_mm * down_mm))
    return Shift(shift, -float(np.degrees(turn)), float(moved * mm), float(sigma * mm), count)


def _rigid(
    centres: Floats, offsets: Floats, weight: Floats, px: float
) -> tuple[tuple[float, float], float, float, float, int] | None:
    """Shift (x, y) px, turn rad, RMS displacement px, its sd px, tiles used; None where the tiles contradict."""
    keep = np.isfinite(offsets[:, 0]) & (weight > 0)
    known = int(keep.sum())
    if known < LEAST_TILES:
        return None
    for _ in range(10):
        p, d, w = centres[keep], offsets[keep], weight[keep]
        # Small turns: d = shift + turn x p.
        zero, one = np.zeros(len(p)), np.ones(len(p))
        A = np.concatenate([np.stack([one, zero, -p[:, 1]], -1), np.stack([zero, one, p[:, 0]], -1)])
        root = np.sqrt(np.tile(w, 2))
        answer = np.linalg.lstsq(A * root[:, None], np.concatenate([d[:, 0], d[:, 1]]) * root, rcond=None)[0]
        turned = np.stack([-centres[:, 1], centres[:, 0]], -1) * answer[2]
        off = np.linalg.norm(offsets - answer[:2] - turned, axis=1)
        limit = max(2.5 * SIGMA_OF_MAD * float(np.median(off[keep])) / 1.18, 0.5)
        kept = np.isfinite(off) & (weight > 0) & (off < limit)
        if kept.sum() < LEAST_TILES or (kept == keep).all():
            break
        keep = kept
    if keep.sum() < max(LEAST_TILES, LEAST_AGREE * len(centres)):
        return None
    residual = off[keep]
    # Two of three numbers are shared: what is left of 2 n values after three unknowns.
    per_axis = float(np.sqrt((residual**2).sum() / max(2 * len(residual) - 3, 1)))
    moved = float(np.sqrt((answer[:2] ** 2).sum() + answer[2] ** 2 * (centres[keep] ** 2).sum(1).mean()))
    sigma = float(np.hypot(per_axis * np.sqrt(2 / len(residual)), 2**0.5 * SHARED_MM / px))
    return (float(answer[0]), float(answer[1])), float(answer[2]), moved, sigma, int(keep.sum())
