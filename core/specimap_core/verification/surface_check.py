"""What displaced patches say of the surface's error, and of poses and lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from specimap_core.arrays import Floats
from specimap_core.geometry.robust import SIGMA_OF_MAD
from specimap_core.verification.figures import SeenError, SurfaceCheck
from specimap_core.verification.held_out import Displacements
from specimap_core.verification.sites import Sites

LEAST_PHOTOS = 2
"""Photos that a place needs to count as checked."""
LEAST_PLACES = 20
LEAST_PATCHES = 8
"""Of a photo, to say by how much all of them are displaced together."""
OFF_PX, OFF_PATCHES, OFF_SIGMAS = 0.7, 10, 5.0
"""A photo is off by itself where its patches are displaced together by more than this, on so many and so surely. On
sound phantoms it was at most 0.4 px; a turn that moves the picture by 1 px is measured as 0.9 to 1.1."""
ALIKE_SHARE, ALIKE_PATCHES = 0.25, 8.0
"""Or where less than this part of the patches that are usual in a photo resemble their prediction, of so many that
should. On sound phantoms it was at least 0.4; of a photo that is off by 2.5 px or more, at most 0.15."""
MEDIAN_OF_NORMAL = 0.6745
SIGMA_OF_MEDIAN = 1.2533
"""Of normal deviates, over that of their mean."""
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


def check_surface(sites: Sites, found: Displacements, pixel_mm: float, names: Sequence[str]) -> SurfaceCheck:
    """The figures; ``pixel_mm``: what a photo's pixel spans on the specimen; ``names``: of the photos."""
    offsets = Offsets.of(found, len(sites.points))
    known = np.isfinite(offsets.offset_mm)
    tried = int(found.tried.sum())
    unlike = 1 - len(found.site) / tried if tried else 1.0
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
        photos_off=tuple(names[k] for k in photos_off(found, offsets)),
    )


def photo_shift_px(found: Displacements, offsets: Offsets) -> float | None:
    """Root mean square over the photos of the median displacement of their patches, surface errors taken out; one told
    by three quarters of the photos, so that a single one that is off does not speak for all."""
    shifts = [np.median(of, axis=0) for of in _residual_px(found, offsets) if len(of) >= LEAST_PATCHES]
    if not shifts:
        return None
    return float(np.sqrt(np.percentile((np.array(shifts) ** 2).sum(1), 75) / QUARTILE_OF_MEAN / 2))


def photos_off(found: Displacements, offsets: Offsets) -> list[int]:
    """Photos that are off by themselves: all that they show is displaced, or resembles nothing."""
    aside = []
    for photo, pixels in enumerate(_residual_px(found, offsets)):
        if len(pixels) < OFF_PATCHES:
            continue
        shift = np.median(pixels, axis=0)
        spread = SIGMA_OF_MAD * np.median(np.abs(pixels - shift), axis=0)
        sigma = SIGMA_OF_MEDIAN * float(np.hypot(*spread)) / np.sqrt(len(pixels))
        if np.hypot(*shift) > max(OFF_PX, OFF_SIGMAS * sigma):
            aside.append(photo)
    alike = np.bincount(found.photo, minlength=len(found.tried))
    tried = np.maximum(found.tried, 1)
    usual = float(np.median((alike / tried)[found.tried > 0])) if found.tried.any() else 0.0
    expected = usual * found.tried
    unlike = np.flatnonzero((expected >= ALIKE_PATCHES) & (alike < ALIKE_SHARE * expected))
    return sorted({*aside, *unlike.tolist()})


def _residual_px(found: Displacements, offsets: Offsets) -> list[Floats]:
    """Of each photo, by how many pixels (n, 2) its patches are displaced, surface errors taken out."""
    pixels = np.einsum("eij,ej->ei", found.px_per_mm, offsets.residual_mm)
    checked = np.isfinite(offsets.offset_mm)[found.site]
    return [pixels[checked & (found.photo == photo)] for photo in range(len(found.tried))]


def _without(value: float, noise: float) -> float:
    """What noise that adds in squares leaves of a value, at least a third of it: noise is known to that extent only."""
    return float(np.sqrt(max(value**2 - noise**2, value**2 / 9)))
