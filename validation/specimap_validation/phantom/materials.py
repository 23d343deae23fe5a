"""Reflectance curves of what a phantom shows: smooth, plausible, from the absorbers' known bands."""

from __future__ import annotations

import numpy as np

from specimap_core.arrays import Floats

MATERIALS = (
    "adipose",
    "fibroglandular",
    "tumour",
    "blood",
    "white_card",
    "black_ink",
    "tray",
    "tray_speckle",
    "bench",
)
ADIPOSE, FIBROGLANDULAR, TUMOUR, BLOOD, WHITE_CARD, BLACK_INK, TRAY, TRAY_SPECKLE, BENCH = range(9)

# Absorption bands: (centre nm, width nm, relative strength). Haemoglobin: Soret, alpha, beta, deoxy 760;
# water and lipid overtones as tabulated for soft tissue in the near infrared.
_HAEMOGLOBIN = ((415.0, 25.0, 3.0), (542.0, 14.0, 1.0), (577.0, 11.0, 1.0), (760.0, 25.0, 0.06))
_WATER = ((975.0, 35.0, 0.25), (1190.0, 45.0, 0.55), (1450.0, 65.0, 2.6), (1700.0, 160.0, 0.9))
_LIPID = (
    (930.0, 14.0, 0.18),
    (1041.0, 18.0, 0.08),
    (1211.0, 22.0, 0.65),
    (1395.0, 24.0, 0.5),
    (1720.0, 26.0, 1.5),
)
_CAROTENE = ((452.0, 38.0, 1.0), (485.0, 20.0, 0.5))
_ABSORBERS = (_HAEMOGLOBIN, _WATER, _LIPID, _CAROTENE)

# Scattering level in the near infrared, what of it is left at 400 nm, amounts of the four absorbers.
_RECIPES = (
    (0.80, 0.72, (0.16, 0.28, 1.00, 0.80)),
    (0.68, 0.60, (0.48, 0.80, 0.15, 0.04)),
    (0.54, 0.55, (0.75, 1.00, 0.05, 0.00)),
    (0.42, 0.25, (1.60, 0.95, 0.02, 0.00)),
    (0.88, 0.90, (0.00, 0.03, 0.04, 0.00)),
    (0.05, 0.75, (0.00, 0.00, 0.00, 0.00)),
    (0.55, 0.96, (0.00, 0.02, 0.03, 0.00)),
    (0.34, 0.95, (0.00, 0.02, 0.03, 0.00)),
    (0.22, 0.55, (0.00, 0.00, 0.00, 0.00)),
)

_RGB_NM = (610.0, 545.0, 460.0)
_RGB_HALF_WIDTH_NM = 30.0


def endmembers(wavelengths_nm: Floats) -> Floats:
    """Reflectance (M, B) in 0..1 of each of ``MATERIALS`` at the wavelengths (B,)."""
    rise = 1 / (1 + np.exp(-(wavelengths_nm - 520) / 60))
    absorbers = np.stack(
        [sum(a * np.exp(-0.5 * ((wavelengths_nm - c) / w) ** 2) for c, w, a in bands) for bands in _ABSORBERS]
    )
    return np.stack(
        [
            level * (left + (1 - left) * rise) * np.exp(-np.array(amounts) @ absorbers)
            for level, left, amounts in _RECIPES
        ]
    )


def linear_rgb() -> Floats:
    """Linear colours (M, 3) of ``MATERIALS`` for a camera with three broad bands."""
    offsets = np.linspace(-_RGB_HALF_WIDTH_NM, _RGB_HALF_WIDTH_NM, 7)
    return np.stack([endmembers(centre + offsets).mean(1) for centre in _RGB_NM], 1)
