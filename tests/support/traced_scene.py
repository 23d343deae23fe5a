"""A path-traced phantom small enough for tests, and where a marker's ink lies in a picture."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View
from specimap_validation.path_traced.settings import TracedSettings

TINY = TracedSettings(
    photos=1,
    photo_size=256,
    cube_rows=112,
    cube_cols=140,
    bands=4,
    mesh_divisions=24,
    samples=16,
    light_samples=8,
    noise=0.0,
    cube_noise=0.0,
    bad_band_fraction=0.0,
    dead_pixel_fraction=0.0,
    aperture_mm=0.0,
)
"""Without noise, defects or defocus, so that what is left is the geometry."""


def ink_shift(picture: Floats, view: View, corners: Floats, *, fine: int = 8) -> Floats:
    """How far (2,) px a marker's black frame lies in ``picture`` (H, W) from where ``view`` sees it at ``corners``.

    The frame's share of each pixel is counted by rays that meet the card's plane, without the renderer.
    """
    low, high = view.project(corners).min(0), view.project(corners).max(0)
    x0, y0 = np.floor(low - 1).astype(int)
    x1, y1 = np.ceil(high + 2).astype(int)
    steps = (np.arange(fine) + 0.5) / fine - 0.5
    cols, rows = np.arange(x0, x1), np.arange(y0, y1)
    pixels = np.stack(np.meshgrid((cols[:, None] + steps).ravel(), (rows[:, None] + steps).ravel()), -1)
    along, down = corners[1] - corners[0], corners[3] - corners[0]
    normal = np.cross(along, down)
    rays, eye = view.world_rays(pixels), view.origins(pixels)
    distance = ((corners[0] - eye) @ normal) / (rays @ normal)
    place = eye + rays * distance[..., None] - corners[0]
    u, v = place @ along / (along @ along), place @ down / (down @ down)
    # Blur carries the cells within the frame into its inner half, and the tray into the card's edge.
    away = np.maximum(np.abs(u - 0.5), np.abs(v - 0.5))
    other = (away < 5 / 12) | (away > 2 / 3)

    def mean(of: Floats) -> Floats:
        return np.asarray(of.reshape(len(rows), fine, len(cols), fine).mean((1, 3)))

    white = mean((away > 1 / 2).astype(float))
    dy, dx = np.gradient(white)
    use = mean(other.astype(float)) == 0
    # Light changes over a card: evenly, as far as this matters.
    y, x = (a / len(a) - 0.5 for a in np.indices(white.shape, float))
    parts = np.stack([np.ones_like(white), white, white * x, white * y, dx, dy], -1)[use]
    solution = np.linalg.lstsq(parts, picture[y0:y1, x0:x1][use], rcond=None)[0]
    return np.asarray(-solution[4:] / solution[1])
