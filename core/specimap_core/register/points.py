"""Make the cloud's points of placements on the surface, with flags and standard deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from specimap_core.arrays import Floats
from specimap_core.cloud import CloudPoints, Flag
from specimap_core.register.placement import GRAZING_DEG, Placement
from specimap_core.surface.raycast import RayCaster
from specimap_core.surface.regions import on_card, on_specimen
from specimap_core.surface.uncertainty import UNSEEN_SIGMA_MM, point_sigma, step_height

INTERPOLATED_SIGMA_MM = 0.9


def cloud_points(
    placement: Placement,
    caster: RayCaster,
    sigma_of_vertex: NDArray[np.float32],
    corners: Floats,
    corner_sigma_mm: float,
    registration_mm: float,
    pixel_mm: float,
    parallax_mm: NDArray[np.float32] | None = None,
) -> CloudPoints:
    """The cloud's points with their flags and standard deviations.

    ``pixel_mm``: what a pixel of the cube spans on the specimen. ``parallax_mm`` (S,): distance from where the solved
    camera puts the same pixels, where the places do not come from it; it is an error of those places and counts in
    their standard deviation.
    """
    if (placement.triangle >= 0).all():
        depth_sigma = caster.interpolate(sigma_of_vertex[:, None], placement.triangle, placement.barycentric).ravel()
    else:
        depth_sigma = np.full(len(placement.xyz), np.float32(np.median(sigma_of_vertex)))
    step_mm = step_height(placement.pixels, placement.xyz[:, 2], pixel_mm)
    sigma = point_sigma(depth_sigma, step_mm, corner_sigma_mm, registration_mm)
    if parallax_mm is not None:
        sigma = np.hypot(sigma, np.nan_to_num(parallax_mm, nan=UNSEEN_SIGMA_MM)).astype(np.float32)
    card = on_card(placement.xyz, corners)
    specimen = on_specimen(placement.pixels, placement.xyz, card, corners)
    flags = (
        specimen * np.uint8(Flag.SPECIMEN)
        + card * np.uint8(Flag.MARKER_CARD)
        + (placement.incidence_deg > GRAZING_DEG) * np.uint8(Flag.GRAZING)
        + placement.occluded * np.uint8(Flag.OCCLUDED)
        + placement.undercut * np.uint8(Flag.UNDERCUT)
        + (depth_sigma > INTERPOLATED_SIGMA_MM * UNSEEN_SIGMA_MM) * np.uint8(Flag.DEPTH_INTERPOLATED)
    ).astype(np.uint8)
    return CloudPoints(placement.pixels, placement.xyz, placement.normal, placement.rgb, sigma, flags)
