"""Exact depth of a phantom's photos, for tests of what measures or completes depth."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.geometry.cameras import View
from specimap_validation.phantom import Scene


def true_depth(scene: Scene, view: View) -> NDArray[np.float32]:
    """Depth (H, W) mm along z of the first surface on each pixel's ray."""
    lens = view.intrinsics
    pixels = np.stack(np.meshgrid(np.arange(lens.width), np.arange(lens.height)), -1).reshape(-1, 2).astype(float)
    rays = view.world_rays(pixels)
    distance = scene.caster.cast(view.cam_from_world.centre, rays).distance
    depth = distance * (rays @ view.cam_from_world.R[2])
    return np.where(np.isfinite(depth), depth, 0).reshape(lens.height, lens.width).astype(np.float32)
