"""The specimen of a path-traced phantom: deep grooves between lobes, and folds that overhang."""

from __future__ import annotations

import numpy as np

from specimap_validation.path_traced.settings import TracedSettings
from specimap_validation.phantom import materials
from specimap_validation.phantom.noise import NoiseVolume
from specimap_validation.phantom.settings import Stream
from specimap_validation.phantom.specimen import (
    Specimen,
    ellipsoid,
    lobules,
    rest_on_tray,
    tissue_of,
    vertex_normals,
)

_GROOVE_WIDTH = 0.16  # in sd of the noise whose zeros the grooves follow
_FINE_MM = 0.012  # breaks highlights into glints, as the skin of wet tissue does


def folded_specimen(settings: TracedSettings) -> Specimen:
    """Build a lobed ellipsoid cut flat at the tray, of the stated extents, with grooves and undercuts."""
    rng = settings.rng(Stream.SHAPE)
    axes, base, outward, triangles = ellipsoid(settings)
    # A double, since noise is single: a plain number would leave the product single.
    tall = np.float64(settings.specimen_mm[2])
    lumps = NoiseVolume(rng, 8.0, 26.0, slope=1.4)(base)
    wrinkles = NoiseVolume(rng, 1.2, 5.0, slope=1.2)(base)
    fine = NoiseVolume(rng, 0.5, 1.6, size=96, slope=0.8)(base)
    regions = NoiseVolume(rng, 6.0, 22.0)(base)
    seams = NoiseVolume(rng, 9.0, 24.0)(base)
    folds = np.stack([NoiseVolume(rng, 7.0, 20.0, slope=1.3)(base) for _ in range(3)], 1)
    crease, fat = lobules(rng, base, axes, regions)
    groove = np.exp(-((seams / _GROOVE_WIDTH) ** 2))

    height = 0.085 * tall * lumps + fat * (0.7 * crease - 0.4) + 0.13 * wrinkles + _FINE_MM * fine
    # Some grooves are shallow: their depth follows the lumps.
    height -= settings.groove_mm * groove * (0.6 + 0.4 * np.clip(lumps, -1, 1))
    vertices = rest_on_tray(base + outward * height[:, None] + settings.fold_mm * folds, settings)
    tissue = tissue_of(rng, base, axes, fat, crease)
    # Connective tissue and blood lie in the grooves.
    filled = np.zeros(len(materials.MATERIALS))
    filled[[materials.FIBROGLANDULAR, materials.BLOOD]] = 0.6, 0.4
    share = 0.5 * groove[:, None]
    tissue = (1 - share) * tissue + share * filled
    return Specimen(vertices, triangles, vertex_normals(vertices, triangles), tissue)
