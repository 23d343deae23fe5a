"""How a phone's sensor and its software turn light into a photo."""

from __future__ import annotations

import cv2
import numpy as np

from specimap_core.arrays import Bytes, Floats, Singles
from specimap_core.photos.colour import srgb_from_linear
from specimap_validation.path_traced.settings import TracedSettings

_EXPOSURE = 0.95
_READ_SHARE = 0.25  # of the variance at a quarter of full scale, the rest of which is the light's own
_SHARPEN_PX = 1.0


def develop(settings: TracedSettings, radiance: Singles, rng: np.random.Generator) -> Bytes:
    """Photo (H, W, 3) of ``radiance`` (H, W, 3), where 1 is white on the open tray."""
    gains: Floats = np.exp(settings.white_balance_spread * rng.standard_normal(3) * [1, 0, 1])
    exposure = _EXPOSURE * 2 ** (settings.exposure_spread * rng.standard_normal())
    light = radiance * (exposure * gains)
    # Photons arrive by chance: the variance grows with the light, from that of the sensor itself.
    variance = _READ_SHARE + (1 - _READ_SHARE) * np.clip(light, 0, 1) / 0.25
    light = light + settings.noise * np.sqrt(variance) * rng.standard_normal(light.shape)
    picture = srgb_from_linear(np.clip(light, 0, 1).astype(np.float32))
    picture = picture + settings.tone_curve * (picture * picture * (3 - 2 * picture) - picture)
    if settings.sharpen:
        picture = picture + settings.sharpen * (picture - cv2.GaussianBlur(picture, (0, 0), _SHARPEN_PX))
    return np.asarray(np.clip(picture * 255 + 0.5, 0, 255), np.uint8)
