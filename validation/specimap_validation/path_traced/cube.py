"""What the cube's camera measures of the lit scene, and the surface that each of its pixels looks at."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats, Singles
from specimap_core.geometry.cameras import View
from specimap_validation.phantom.render import CLASS_BENCH, CLASS_CARD, CLASS_SPECIMEN, CLASS_TRAY
from specimap_validation.phantom.scene import RayCaster

_CLASSES = {"specimen": CLASS_SPECIMEN, "cards": CLASS_CARD, "tray": CLASS_TRAY}
_START_Z_MM = 60.0  # above everything, and close enough for single precision
_BLOCK = 16384


def first_hits(view: View, meshes: dict[str, tuple[Floats, NDArray[np.int32]]]) -> tuple[Floats, NDArray[np.uint8]]:
    """Points (H, W, 3) mm that the rays of the pixels' middles meet, NaN for none, and their classes (H, W)."""
    h, w = view.intrinsics.height, view.intrinsics.width
    pixels = np.stack(np.meshgrid(np.arange(w), np.arange(h)), -1).reshape(-1, 2).astype(float)
    directions = view.world_rays(pixels)
    origins = np.broadcast_to(view.origins(pixels), directions.shape)
    start = origins + ((_START_Z_MM - origins[:, 2]) / directions[:, 2])[:, None] * directions
    caster = RayCaster(list(meshes.values()))
    # What is no specimen, card or tray counts as bench, which the truth leaves out, too.
    classes = np.array([_CLASSES.get(name, CLASS_BENCH) for name in meshes], np.uint8)
    points, found = np.full((h * w, 3), np.nan), np.zeros(h * w, np.uint8)
    for first in range(0, h * w, _BLOCK):
        block = slice(first, first + _BLOCK)
        hits = caster.cast(start[block], directions[block])
        met = hits.geometry >= 0
        points[block][met] = (start[block] + directions[block] * hits.distance[:, None])[met]
        found[block][met] = classes[hits.geometry[met]]
    return points.reshape(h, w, 3), found.reshape(h, w)


def shift_bands(cube: Singles, largest_px: float, rng: np.random.Generator) -> None:
    """Shift the bands of a cube (H, W, B) against the middle one, in place, by up to ``largest_px`` at both ends.

    Half is an offset in a random direction; the rest magnifies along the rows (keystone) and bends them (smile).
    """
    h, w, bands = cube.shape
    angle = rng.uniform(0, 2 * np.pi)
    col, row = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    across = (col - (w - 1) / 2) / (w / 2)
    for b, share in enumerate(np.linspace(-1, 1, bands)):
        right = largest_px * share * (np.cos(angle) + across) / 2
        down = largest_px * share * (np.sin(angle) + across**2 - 1 / 3) / 2
        x, y = (col + right).astype(np.float32), (row + down).astype(np.float32)
        band = np.ascontiguousarray(cube[..., b])
        cube[..., b] = cv2.remap(band, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
