"""The certificate of a result as text and a table."""

from __future__ import annotations

from collections.abc import Iterator

from specimap_core.notices import few_of
from specimap_core.report.blocks import Block, Callout, Level, Table
from specimap_core.report.wording import WARNING_ADVICE, mm
from specimap_core.verification.figures import Certificate, SeenError

TITLES: dict[str, tuple[Level, str]] = {
    "trusted": ("good", "Trusted: nothing that was held out contradicts the result."),
    "doubtful": ("attention", "Doubtful: look at the reasons before use."),
    "not_trusted": ("attention", "Not trusted: what was held out contradicts the result."),
}


def certificate_blocks(found: Certificate) -> Iterator[Block]:
    """The verdict with its reasons, and the figures."""
    level, title = TITLES[found.verdict]
    why = " ".join(code.replace("_", " ").capitalize() + "." for code in found.reasons)
    text = (
        "Photos that a place was not measured with were predicted from the result, and so was the cube's picture. What "
        f"disagrees is an error seen, without any truth. {why}"
    )
    yield Callout(level, title, text.strip(), " ".join(WARNING_ADVICE[code] for code in found.reasons))
    yield Table(
        "Errors seen, mm", ("Of", "Median", "95 %", "Rests on"), tuple(_rows(found)), (0.24, 0.14, 0.14, 0.48), (1, 2)
    )


def _rows(found: Certificate) -> Iterator[tuple[str, str, str, str]]:
    surface, registration, bands = found.surface, found.registration, found.bands
    rests = (
        f"{surface.patches} patches at {surface.checked} of {surface.places} places; "
        f"{100 * surface.unlike:.0f} % of the patches resemble no prediction"
    )
    yield ("Surface", *_seen(surface.seen_mm), rests)
    if registration is not None:
        yield ("Registration", *_seen(registration.seen_mm), f"{registration.tiles} tiles of the cube's picture")
    yield ("Both together", *_seen(found.total_mm), f"stated sigma was multiplied by {found.sigma_factor:.2f}")
    if surface.photo_shift_px is not None:
        alone = f"; off by themselves: {few_of(surface.photos_off)}" if surface.photos_off else ""
        yield ("Poses and lens", f"{surface.photo_shift_px:.3f} px", "", f"RMS over the photos{alone}")
    if bands is not None:
        off = f"{bands.shift_px:.3f} px", f"{bands.growth_px:.3f} px"
        yield ("Bands: shift, growth", *off, f"{bands.blocks} blocks of the last third of the bands against the first")


def _seen(error: SeenError | None) -> tuple[str, str]:
    return ("–", "–") if error is None else (mm(error.median), mm(error.p95))
