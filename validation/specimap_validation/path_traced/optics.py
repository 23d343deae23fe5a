"""What spreads a pixel's rays: the lens, its opening, and a hand that is not quite still."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import View
from specimap_validation.path_traced.settings import TracedSettings

_FOCUS_AT_MM = np.array([0.0, 0.0, 5.0])


def _still() -> Floats:
    return np.zeros(3)


@dataclass(frozen=True)
class Optics:
    """What spreads the rays of a pixel.

    ``blur_px``: sd of the lens's Gaussian. ``aperture_mm``: radius of the opening; ``focus_mm``: depth in focus.
    ``turn``: rotation vector of the rays in the world over the exposure; ``rolling``: the same from the first row to
    the last. Both are zero in the middle of the exposure and of the picture, which is the camera's pose.
    """

    blur_px: float = 0.0
    aperture_mm: float = 0.0
    focus_mm: float = 400.0
    turn: Floats = field(default_factory=_still)
    rolling: Floats = field(default_factory=_still)


def optics_of(settings: TracedSettings, view: View, rng: np.random.Generator) -> Optics:
    """Optics of one photo: it is in focus somewhere near the specimen, and the hand is not quite still."""
    focal = view.intrinsics.focal_px
    in_image = view.cam_from_world.R[:2]  # turns about the image's axes move the picture, one about the third does not
    depth = float(view.cam_from_world.apply(_FOCUS_AT_MM)[2])
    motion, rolling = (
        length / focal * (rng.standard_normal(2) / 2**0.5) @ in_image
        for length in (settings.motion_px, settings.rolling_px)
    )
    focus = depth * (1 + settings.focus_spread * rng.standard_normal())
    return Optics(settings.blur_px, settings.aperture_mm, focus, motion, rolling)
