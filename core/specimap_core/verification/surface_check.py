"""What displaced patches say of the surface's error, and of poses and lens."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.verification.figures import SeenError, SurfaceCheck
from specimap_core.verification.held_out import Displacements
from specimap_core.verification.sites import Sites

LEAST_PHOTOS = 2
"""Photos that a place needs to count as checked."""
LEAST_PLACES = 20
LEAST_PATCHES = 8
"""Of a photo, to say by how much all of them are displaced together."""
MEDIAN_OF_NORMAL = 0.6745
QUARTILE_OF_MEAN = 1.386
"""Third quartile of squared distances in two dimensions over their mean, for a normal distribution."""
MEDIAN_OF_CHI2 = 1.386
"""Of a chi-squared distribution of two degrees of freedom."""
ERROR_OF_OFFSET, P95_OF_OFFSET = 1.75, 2.8
"""Median and 95th percentile of the true error over those of the offset seen, as far as all patches resemble their
prediction: a patch sees the mean of the error within it alone, and a spectrum lies aside, too. Where patches resemble
nothing, the surface errs more; both grow by the share of these. Set on own phantoms of seeds 101 and 102; the text of
docs/accuracy.md has what came of it on others."""


@dataclass(frozen=True)
class Offsets:
    """Of P sites: ``offset_mm`` (P,) of the true surface from the mesh along the normal, with its standard error
    ``sigma_mm`` (P,), both NaN where fewer than ``LEAST_PHOTOS`` were compared; ``residual_mm`` (E, 2): what
    that leaves of the displacements."""

    offset_mm: Floats
    sigma_mm: Floats
    residual_mm: Floats

    @staticmethod
    def of(found: Displacements, sites: int) -> Offsets:
        """Least squares over the photos of each site."""
        weight = np.linalg.inv(found.covariance)
        pull = np.einsum("ei,eij->ej", found.slope, weight)
        by_pull = np.bincount(found.site, (pull * found.shift_mm).sum(1), sites)
        information = np.bincount(found.site, (pull * found.slope).sum(1), sites)
        enough = np.bincount(found.site, minlength=sites) >= LEAST_PHOTOS
        information = np.where(enough & (information > 0), information, np.nan)
        offset = by_pull / information
        residual = found.shift_mm - found.slope * np.nan_to_num(offset)[found.site][:, None]
        # The fit's own residuals are no white noise: what they leave tells by how much more the displacements err.
        checked = enough[found.site]
        misfit = np.einsum("ei,eij,ej->e", residual, weight, residual)[checked]
        excess = float(np.sqrt(np.median(misfit) / MEDIAN_OF_CHI2)) if checked.any() else 1.0
        return Offsets(offset, max(excess, 1.0) / np.sqrt(information), residual)


def check_surface(sites: Sites, found: Displacements, pixel_mm: float) -> SurfaceCheck:
    """The figures; ``pixel_mm``: what a photo's pixel spans on the specimen."""
    offsets = Offsets.of(found, len(sites.points))
    known = np.isfinite(offsets.offset_mm)
    tried = len(found.site) + found.unlike
    unlike = found.unlike / tried if tried else 1.0
    seen, offset_mm, lean_mm = None, None, None
    if known.sum() >= LEAST_PLACES:
        off, noise = np.abs(offsets.offset_mm[known]), float(np.median(offsets.sigma_mm[known]))
        lean_mm = float(np.median(offsets.offset_mm[known]))
        offset_mm = _without(float(np.median(off)), MEDIAN_OF_NORMAL * noise)
        most = _without(float(np.percentile(off, 95)), 1.96 * noise)
        seen = SeenError(
            median=ERROR_OF_OFFSET * (1 + unlike) * offset_mm, p95=P95_OF_OFFSET * (1 + unlike) * max(most, offset_mm)
        )
    shift_px = photo_shift_px(found, offsets)
    return SurfaceCheck(
        places=len(known),
        checked=int(known.sum()),
        patches=len(found.site),
        unlike=unlike,
        offset_mm=offset_mm,
        lean_mm=lean_mm,
        pixel_mm=pixel_mm,
        seen_mm=seen,
        photo_shift_px=shift_px,
    )


def photo_shift_px(found: Displacements, offsets: Offsets) -> float | None:
    """Root mean square over the photos of the median displacement of their patches, surface errors taken out; one told
    by three quarters of the photos, so that a single one that is off does not speak for all."""
    pixels = np.einsum("eij,ej->ei", found.px_per_mm, offsets.residual_mm)
    checked = np.isfinite(offsets.offset_mm)[found.site]
    shifts = [
        np.median(pixels[of], axis=0)
        for photo in np.unique(found.photo[checked])
        if (of := checked & (found.photo == photo)).sum() >= LEAST_PATCHES
    ]
    if not shifts:
        return None
    return float(np.sqrt(np.percentile((np.array(shifts) ** 2).sum(1), 75) / QUARTILE_OF_MEAN / 2))


def _without(value: float, noise: float) -> float:
    """What noise that adds in squares leaves of a value, at least a third of it: noise is known to that extent only."""
    return float(np.sqrt(max(value**2 - noise**2, value**2 / 9)))
