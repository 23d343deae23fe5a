"""Cases of a validation: phantoms with one defect each, and acquisitions with truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from specimap_core.errors import NotFoundError
from specimap_validation.capture import Capture, find_capture
from specimap_validation.phantom import PhantomSettings

FULL = PhantomSettings(bands=16, wavelength_nm=(400.0, 1000.0))
QUICK = replace(FULL, photos=16, photo_size=448, cube_rows=256, cube_cols=320, bands=8)
"""Fewer and smaller photos and a smaller cube: to check that everything works, not how well."""
MOVED = "specimen moved"
"""A defect that no registration by markers can correct; the question is whether it is noticed."""
QUICK_DEFECTS = ("none", "blur", "tilted cards", MOVED)
SEEDS = (1, 2, 3)
DEFECTS: dict[str, dict[str, Any]] = {
    "none": {},
    "blur": {"blur_px": 1.0},
    "strong blur": {"blur_px": 1.5},
    "gloss": {"gloss": 0.6},
    "exposure": {"exposure_spread": 0.4},
    "tilted cards": {"card_tilt_deg": 2.5, "card_lift_mm": 0.5},
    "lens distortion": {"k1": -0.12, "k2": 0.03},
    "focal breathing": {"focal_spread": 0.01},
    MOVED: {"moved_mm": (0.8, -0.6, 0.0), "moved_deg": 2.0, "moved_tilt_deg": 1.0},
    "noisy cube": {"bad_band_fraction": 0.15, "dead_pixel_fraction": 0.01, "cube_noise": 0.02},
    "weak texture": {"texture_contrast": 0.2},
}
"""Changes to a phantom's settings, by the name that the tables show."""


@dataclass(frozen=True)
class Case:
    """An acquisition to validate on: a phantom to be made from ``settings``, or a ``capture`` with truth."""

    defect: str
    seed: int | None
    settings: PhantomSettings | None = None
    capture: Capture | None = None


def cases(seeds: tuple[int, ...], acquisitions: tuple[Path, ...], *, quick: bool) -> list[Case]:
    """List each defect with each seed, then the acquisitions.

    Raises:
        NotFoundError: an acquisition is not there, or holds no truth.
        SettingsError: a seed is negative.
    """
    base, names = (QUICK, QUICK_DEFECTS) if quick else (FULL, tuple(DEFECTS))
    captures = [find_capture(folder) for folder in acquisitions]
    for capture in captures:
        if not capture.has_truth:
            raise NotFoundError(f"{capture.folder} holds no truth.npz.", advice="Only what has truth can validate.")
    phantoms = [Case(name, seed, replace(base, seed=seed, **DEFECTS[name])) for name in names for seed in seeds]
    return [*phantoms, *(Case(capture.name, None, capture=capture) for capture in captures)]
