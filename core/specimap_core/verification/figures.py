"""Figures of the certificate: what a result's check against unused evidence gave."""

from __future__ import annotations

from typing import Literal

from specimap_core.register.figures import Figure, Section

Verdict = Literal["trusted", "doubtful", "not_trusted"]


class SeenError(Section):
    """Error of the specimen's points that the check shows, mm: median and 95th percentile."""

    median: Figure
    p95: Figure


class SurfaceCheck(Section):
    """Photos against what the other photos predict through surface and cameras.

    ``places``: where it was tried on the specimen, ``checked``: where two or more photos that the surface was not
    refined on could be compared; ``patches`` compared, ``unlike``: share of those tried that resemble no prediction;
    ``offset_mm``: median distance along the normal by which the surface seems off, without the noise of measuring it,
    and ``lean_mm``, the median with its sign, by which all of it seems too low; ``seen_mm``: the error of points that
    this stands for, None where too few places were checked; ``photo_shift_px``: root mean square over the photos of
    what displaces all patches of one together, in pixels of ``pixel_mm`` on the specimen; ``photos_off``: those that
    are off by themselves.
    """

    places: int
    checked: int
    patches: int
    unlike: Figure
    offset_mm: Figure | None
    lean_mm: Figure | None
    seen_mm: SeenError | None
    photo_shift_px: Figure | None
    photos_off: tuple[str, ...] = ()
    pixel_mm: Figure


class RegistrationCheck(Section):
    """The cube's picture against the photos' colours through the final camera: ``tiles`` of the specimen that could be
    compared, what is left of their displacement on the tissue, and the standard error of a tile's own."""

    tiles: int
    seen_mm: SeenError
    tile_sigma_mm: Figure


class BandsCheck(Section):
    """The last third of the cube's bands against the first: ``shift_px`` in the middle; ``growth_px``: what turn,
    stretch and skew add at the edge of the layout; ``sigma_px``, of the shift."""

    blocks: int
    shift_px: Figure
    growth_px: Figure
    sigma_px: Figure


class Certificate(Section):
    """Check of a result against evidence that was not used to make it. It knows no truth.

    ``total_mm``: surface and registration together; ``sigma_factor``: what the specimen's ``sigma_mm`` was multiplied
    by, since more was seen than stated; ``reasons``: codes of the warnings that the verdict rests on.
    """

    verdict: Verdict
    reasons: list[str]
    total_mm: SeenError | None
    surface: SurfaceCheck
    registration: RegistrationCheck | None
    bands: BandsCheck | None
    sigma_factor: Figure
