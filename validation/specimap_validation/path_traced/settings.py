"""Settings of a path-traced phantom, and the presets that reproduce one kind of acquisition each."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from specimap_core.errors import SettingsError
from specimap_validation.phantom.settings import PhantomSettings, Stream, check_ranges

_LEAST: dict[str, float] = dict.fromkeys(
    (
        *("groove_mm", "fold_mm", "scatter_mm", "tray_contrast", "card_gloss", "card_bend_mm"),
        *("aperture_mm", "focus_spread", "motion_px", "rolling_px", "principal_spread_px"),
        *("white_balance_spread", "tone_curve", "sharpen", "band_shift_px", "scan_drift", "scan_jitter_px"),
    ),
    0.0,
) | {"coat_roughness": 0.02, "samples": 1, "light_samples": 1, "light_depth": 2, "thinned": 1}
_MOST: dict[str, float] = {
    "groove_mm": 4,
    "fold_mm": 3,
    "card_bend_mm": 0.5,
    "coat_roughness": 1,
    "focus_spread": 0.2,
    "white_balance_spread": 0.5,
    "tone_curve": 1,
    "scan_drift": 0.1,
    "scan_jitter_px": 2,
}


@dataclass(frozen=True)
class TracedSettings(PhantomSettings):
    """A path-traced phantom's recipe: a quick phantom's, and what only light and a real camera add.

    The same settings give the same bytes with the same Mitsuba and LLVM. Raises ``SettingsError`` out of range.
    """

    mesh_divisions: int = 190
    gloss: float = 1.0
    """Share of the wet coat's reflection: 1 is that of water on tissue."""
    blur_px: float = 0.35
    """Gaussian sd of the lens at its best focus."""
    noise: float = 0.006
    """Sd of the photos' noise at a quarter of full scale, in linear light; it grows with the root of the light."""
    bands: int = 24
    cube_noise: float = 0.006
    bad_band_fraction: float = 0.04
    dead_pixel_fraction: float = 1e-4

    # ---- specimen and light ----
    groove_mm: float = 1.6
    """Depth of the grooves between the lobes."""
    fold_mm: float = 1.0
    """Sd of the shift that folds the surface over itself: undercuts."""
    scatter_mm: float = 0.35
    """How far light wanders under the surface; red goes farther and blue less far."""
    coat_roughness: float = 0.1
    """GGX roughness of the wet coat, and of glossy cards."""
    tray_contrast: float = 0.4
    """Strength of the tray's speckle, whose full strength a quick phantom has."""
    light_samples: int = 64
    """Paths from each place of a surface, by which its light is found."""
    light_depth: int = 6
    """Most segments of a path from a lamp to the camera."""

    # ---- cards ----
    card_gloss: float = 0.0
    """Share of the coat's reflection on the cards."""
    card_bend_mm: float = 0.0
    """Largest bend of a card: height of its edges over its middle, up or down."""

    # ---- photos ----
    samples: int = 24
    """Rays of a pixel."""
    thinned: int = 1
    """One in so many photos is taken of a round that would hold ``photos`` times as many."""
    aperture_mm: float = 0.5
    """Radius of the lens's opening: defocus grows with it and with the distance from the plane in focus."""
    focus_spread: float = 0.02
    """Relative sd of the distance in focus."""
    motion_px: float = 0.0
    """Root mean square of the length by which the picture moves during the exposure."""
    rolling_px: float = 0.0
    """Root mean square of the shift from the first row to the last, which are exposed one after the other."""
    principal_spread_px: float = 0.8
    """Sd of the principal point, which all photos share, about the middle."""
    white_balance_spread: float = 0.0
    """Sd of the logarithm of the gains of red and blue from photo to photo."""
    tone_curve: float = 0.0
    """How far sRGB is bent to an S as phones do: 0 not, 1 all the way to a smooth step."""
    sharpen: float = 0.0
    """Strength of an unsharp mask of 1 px."""
    quality: tuple[int, int] = (85, 92)
    """Least and greatest JPEG quality."""

    # ---- cube ----
    cube_principal_px: tuple[float, float] = (0.0, 0.0)
    """How far the cube's principal point lies off its middle."""
    band_shift_px: float = 0.0
    """Largest shift of the outermost bands against the middle one: magnification, bent lines and an offset."""
    scan_drift: float = 0.0
    """Relative change of a push-broom's speed from its first line to its last."""
    scan_jitter_px: float = 0.0
    """Sd by which each line of a push-broom is early or late."""
    covered: tuple[int, ...] = ()
    """Markers that something lies on while the cube is taken."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_ranges(self, _LEAST, _MOST)
        if not 1 <= self.quality[0] <= self.quality[1] <= 100:
            raise SettingsError("quality is no range in 1..100.", advice="Give (least, greatest).", setting="quality")
        if not set(self.covered) <= set(self.marker_ids):
            raise SettingsError(
                "covered names markers that are not there.", advice="Name some of marker_ids.", setting="covered"
            )
        if self.bare_photos:
            raise SettingsError(
                "A path-traced phantom shows its cards in every photo.",
                advice="Leave bare_photos empty.",
                setting="bare_photos",
            )


_GLOSS = {"gloss": 1.8, "coat_roughness": 0.07}
_BLUR = {"aperture_mm": 1.6, "focus_spread": 0.04, "motion_px": 2.8, "blur_px": 0.5}
_EXPOSURE = {"exposure_spread": 0.25}
_BREATHING = {"focal_spread": 0.006}
_CARDS = {"card_tilt_deg": 4.0, "card_lift_mm": 0.4, "card_bend_mm": 0.05}
_LENS = {"k1": -0.03, "k2": 0.02}
_BLURRED = {**_BLUR, **_GLOSS, **_EXPOSURE, **_BREATHING, "band_shift_px": 0.5}

PRESETS: dict[str, dict[str, Any]] = {
    "clean": {"photos": 24},
    "blurred": {"photos": 30, **_BLURRED},
    "half": {"photos": 15, "thinned": 2, **_BLURRED},
    "tilted": {"photos": 20, **_GLOSS, **_CARDS, **_LENS},
    # In the cube's corner, its lens is off by 0.9 %.
    "cube-distorted": {"photos": 26, **_BLUR, **_EXPOSURE, **_BREATHING, **_GLOSS, **_CARDS, "cube_k1": 0.515},
    "moved": {"photos": 24, **_BLUR, **_GLOSS, "covered": (2,), "moved_mm": (0.8, -0.6, 0.0), "moved_deg": 1.5},
    "noisy": {
        "photos": 22,
        "noise": 0.03,
        "cube_noise": 0.02,
        "card_gloss": 1.0,
        "white_balance_spread": 0.06,
        **_LENS,
        **_BREATHING,
    },
    "pushbroom": {"photos": 24, "cube_scan": "rows", "scan_drift": 0.01, "scan_jitter_px": 0.2},
}
"""Changes to the settings, by the name of the kind of acquisition."""


def preset(name: str, seed: int) -> TracedSettings:
    """Settings of the preset ``name``; the specimen's size follows from ``seed``, too. Raises ``SettingsError``."""
    if name not in PRESETS:
        raise SettingsError(f"There is no preset {name}.", advice=f"Use {', '.join(PRESETS)}.", setting="preset")
    if seed < 0:
        raise SettingsError(f"seed is {seed}.", advice="Give 0 or more.", setting="seed")
    size = np.random.default_rng([seed, Stream.SHAPE, 1]).uniform((28, 25, 12), (35, 30, 15))
    x, y, height = (round(float(s), 1) for s in size)
    return TracedSettings(seed=seed, specimen_mm=(x, y, height), **PRESETS[name])
