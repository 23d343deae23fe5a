"""The report's figures as named numbers with units, for the structured report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from highdicom.sr import CodedConcept

from specimap_core.report.model import Report
from specimap_hospital.dicom.codes import MICROMETRE, MILLIMETRE, NO_UNIT, PERCENT, PIXELS, own


@dataclass(frozen=True)
class Number:
    """A measurement; viewers drop how it was derived, so that its name says it."""

    name: CodedConcept
    value: float
    unit: CodedConcept


def summary(report: Report) -> list[Number]:
    """The figures of the whole result, the most telling ones first, since viewers show five; those that the run could
    not have are left out. Errors are in micrometres, since viewers round to two decimals."""
    return [number for number in _summary(report) if math.isfinite(number.value)]


def _summary(report: Report) -> Iterator[Number]:
    flat, high, left = report.corner_2d_mm, report.corner_3d_mm, report.leave_one_marker_out_mm
    edge, parallax, sigma = report.edge_length_mm, report.parallax_removed_mm, report.sigma_mm
    yield _error("sigma_median", "Stated SD of a point of the specimen, median", sigma.median)
    yield _error("sigma_p95", "Stated SD of a point of the specimen, 95th percentile", sigma.p95)
    yield _error("corner_2d_mean", "2D corner error, mean", flat.mean)
    yield _error("corner_3d_median", "3D corner error, median", high.median)
    if left is not None:
        yield _error("left_out_median", "Leaving a marker out, error, median", left.median)
        yield _error("left_out_largest", "Leaving a marker out, error, largest", left.maximum)
    yield _error("corner_2d_sd", "2D corner error, SD", flat.std)
    yield _error("corner_3d_q1", "3D corner error, lower quartile", high.q1)
    yield _error("corner_3d_q3", "3D corner error, upper quartile", high.q3)
    certificate = report.certificate
    if certificate is not None and certificate.total_mm is not None:
        seen = certificate.total_mm
        yield _error("seen_median", "Error seen with unused evidence, median", seen.median)
        yield _error("seen_p95", "Error seen with unused evidence, 95th percentile", seen.p95)
    yield Number(own("edge_known", "Marker edge, as given"), edge.expected, MILLIMETRE)
    yield Number(own("edge_mean", "Marker edge, measured, mean"), edge.mean, MILLIMETRE)
    yield _error("edge_sd", "Marker edge, measured, SD", edge.std)
    yield _error("parallax_median", "Between the two registration methods, median", parallax.median)
    yield _error("parallax_largest", "Between the two registration methods, largest", parallax.maximum)
    yield Number(own("photo_rms", "Corners in the photos, RMS"), report.reprojection_px.after, PIXELS)
    yield Number(own("cube_rms", "Corners in the cube, RMS"), report.cube_camera.reprojection_rms_px, PIXELS)
    covered = 100 * report.coverage.between_markers
    yield Number(own("coverage", "Pixels between the markers with a point"), covered, PERCENT)
    yield Number(own("photos_used", "Photos used"), len(report.photos.used), NO_UNIT)
    yield Number(own("photos_given", "Photos given"), report.photos.given, NO_UNIT)
    yield Number(own("specimen_points", "Points of the specimen"), report.coverage.specimen_points, NO_UNIT)


def _error(code: str, meaning: str, mm: float) -> Number:
    return Number(own(code, meaning), 1000 * mm, MICROMETRE)


def corners_in_cube(report: Report, mm_per_px: float) -> dict[tuple[int, int], Number]:
    """How far the cube's solved camera puts each marker's corner from where it was measured, by marker and corner (0 to
    3); none in reports of versions that did not keep them.

    ``mm_per_px``: of the cube's pixels in the markers' plane; see :func:`~specimap_core.report.maps.spacing_mm`.
    """
    seen = report.cube_corners
    if seen is None or not math.isfinite(mm_per_px):
        return {}
    found = {}
    for marker, residuals in zip(seen.marker_ids, seen.residuals_px, strict=True):
        for corner, px in enumerate(np.linalg.norm(np.array(residuals, float).reshape(4, 2), axis=1)):
            found[marker, corner] = _error("corner_residual", "Corner in the cube, residual", float(px * mm_per_px))
    return {place: number for place, number in found.items() if math.isfinite(number.value)}


def markers_left_out(report: Report) -> dict[int, Number]:
    """The error at each marker where the registration was fitted without it."""
    left = report.leave_one_marker_out_mm
    found = {} if left is None else {int(marker): value for marker, value in left.per_marker.items()}
    return {
        marker: _error("marker_left_out", "Error at this marker when it is left out", value)
        for marker, value in found.items()
        if math.isfinite(value)
    }
