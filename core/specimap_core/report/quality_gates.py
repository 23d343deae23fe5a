"""Quality gates on a finished run's figures: warnings, and a refusal where nothing usable is left.

Limits were set between sets that are in order and broken ones. In order: the phantoms (corners 0.05 to 0.21 px RMS, the
worst photo 0.53 px and 4 times the median, coverage above 99 %) and 42 real photos (0.49 px at 1280 px). Broken: a card
2 mm elsewhere in half of the photos (1.04 px; in one photo, 4.5 px there), in half of them by 6 mm (3.3 px, coverage
0.1 %), a cube of other markers (12.8 px, 7 mm), photos from one side (coverage 70 %).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from specimap_core.errors import RegistrationError, ResultInsufficientError
from specimap_core.notices import Notice
from specimap_core.report.model import PhotoCorners, Report

LEAST_COVERAGE = 0.97
"""Of the cube's pixels between the markers."""
USELESS_COVERAGE = 0.1
USELESS_WITHOUT_SPECIMEN = 0.5
"""Coverage below which a result without any point of a specimen is refused, and one of photos that contradict each
other."""
MOST_CORNER_RMS_PX = 0.8
OUTLYING_PX = 1.2
"""RMS of a photo's corners; with the following, whichever is more."""
OUTLYING_MEDIANS = 6.0
SIZE_OF_LIMITS_PX = 1280
"""Longer side of the photos up to which these limits hold; they grow with larger ones."""
MOST_CUBE_RMS_PX = 1.0
FOREIGN_CUBE_EDGES = 0.5
"""Mean error of the cube's corners in marker edges from which its markers are others than the photos'."""
MOST_NAMED = 6


@dataclass(frozen=True)
class Outlying:
    """A photo whose corners lie off, RMS ``px``; the ``marker`` that lies off most, by ``marker_px``."""

    name: str
    px: float
    marker: int
    marker_px: float


def corner_limit_px(report: Report) -> float:
    """The most that the RMS of the photos' corners may be."""
    return MOST_CORNER_RMS_PX * _scale(report.photo_corners or [])


def outlying_photos(report: Report) -> list[Outlying]:
    """Photos whose corners lie far more off than the others', the worst first.

    A marker is as far off as three of its corners are: where something hides its edge, one or two corners are
    misplaced, which the adjustment takes out, and a card that moved takes all four along.
    """
    photos = [p for p in report.photo_corners or [] if p.residuals_px]
    if not photos:
        return []
    distances = [(np.array(p.residuals_px).reshape(len(p.residuals_px), 4, 2) ** 2).sum(2) for p in photos]
    squares = [np.sort(d, axis=1)[:, 1] for d in distances]
    rms = np.array([float(np.sqrt(s.mean())) for s in squares])
    limit = max(OUTLYING_PX * _scale(photos), OUTLYING_MEDIANS * float(np.median(rms)))
    found = [
        Outlying(p.name, float(r), p.marker_ids[int(s.argmax())], float(np.sqrt(s.max())))
        for p, r, s in zip(photos, rms, squares, strict=True)
        if r > limit
    ]
    return sorted(found, key=lambda o: -o.px)


def _scale(photos: list[PhotoCorners]) -> float:
    longer = max((max(p.width_px, p.height_px) for p in photos), default=0)
    return max(1.0, longer / SIZE_OF_LIMITS_PX)


def gated(report: Report, edge_mm: float) -> Report:
    """The report with the warnings that its own figures call for.

    Raises:
        RegistrationError: the markers in the cube are not those in the photos.
        ResultInsufficientError: hardly anything has a point.
    """
    warnings = _warnings(report)
    _check_cube(report, edge_mm)
    _check_useful(report, warnings)
    return report.model_copy(update={"warnings": [*report.warnings, *warnings]})


def _warnings(report: Report) -> list[Notice]:
    warnings: list[Notice] = []
    coverage, rms, outlying = report.coverage, report.reprojection_px.after, outlying_photos(report)
    if not coverage.between_markers > LEAST_COVERAGE:
        warnings.append(
            Notice(
                "coverage_low",
                f"Only {100 * coverage.between_markers:.1f} % of the cube's pixels between the markers have a point.",
            )
        )
    if not coverage.specimen_points:
        warnings.append(Notice("specimen_not_found", "Nothing rises above the markers' plane as a specimen does."))
    if not rms <= corner_limit_px(report):
        warnings.append(
            Notice(
                "corners_scatter",
                f"The markers' corners in the photos lie {rms:.2f} px (RMS) from where all photos together put them; "
                f"{corner_limit_px(report):.1f} px are the most to be expected.",
            )
        )
    if outlying:
        named = "; ".join(
            f"{o.name} {o.px:.1f} px, marker {o.marker} {o.marker_px:.1f} px" for o in outlying[:MOST_NAMED]
        )
        more = f"; and {len(outlying) - MOST_NAMED} more" if len(outlying) > MOST_NAMED else ""
        warnings.append(Notice("photo_outlying", f"In some photos the markers' corners lie off: {named}{more}."))
    cube = report.cube_camera.reprojection_rms_px
    if not cube <= MOST_CUBE_RMS_PX:
        warnings.append(
            Notice(
                "cube_corners_scatter",
                f"The markers' corners in the cube lie {cube:.2f} px (RMS) from where its solved camera puts them.",
            )
        )
    return warnings


def _check_cube(report: Report, edge_mm: float) -> None:
    off = report.corner_2d_mm.mean
    if off > FOREIGN_CUBE_EDGES * edge_mm:
        raise RegistrationError(
            f"The markers lie elsewhere in the cube than in the photos, by {off:.1f} mm on average.",
            advice="Give the photos and the cube of one specimen between unmoved markers.",
            corner_mm=off,
            reprojection_px=report.cube_camera.reprojection_rms_px,
        )


def _check_useful(report: Report, warnings: list[Notice]) -> None:
    covered, specimen = report.coverage.between_markers, report.coverage.specimen_points
    codes = {w.code for w in warnings}
    whole = specimen and "corners_scatter" not in codes
    if covered >= (USELESS_COVERAGE if whole else USELESS_WITHOUT_SPECIMEN):
        return
    advice = "Take 20 or more sharp photos all around, in which the specimen with all markers fills the picture."
    if codes & {"corners_scatter", "photo_outlying"}:
        advice = "The photos contradict each other: something moved in between. Take all again, touching nothing."
    raise ResultInsufficientError(
        " ".join(w.message for w in warnings),
        advice=advice,
        between_markers=covered,
        points=report.coverage.points,
        specimen_points=specimen,
        photos_used=len(report.photos.used),
        corner_rms_px=report.reprojection_px.after,
    )
