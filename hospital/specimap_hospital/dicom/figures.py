"""The report's figures as named numbers with units, for the structured report."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from specimap_core.report.model import Report
from specimap_hospital.dicom.codes import MILLIMETRE, NO_UNIT, PERCENT, PIXELS, CodedConcept, own


@dataclass(frozen=True)
class Number:
    """A measurement; viewers drop how it was derived, so that its name says it."""

    name: CodedConcept
    value: float
    unit: CodedConcept


@dataclass(frozen=True)
class Corner:
    """A corner of a marker in the cube: 0 to 3, and how far its solved camera puts it from where it was measured."""

    marker: int
    corner: int
    residual_px: float
    residual_mm: float


def summary(report: Report) -> list[Number]:
    """The figures of the whole result; those that the run could not have are left out."""
    return [number for number in _summary(report) if math.isfinite(number.value)]


def _summary(report: Report) -> Iterator[Number]:
    flat, high, left = report.corner_2d_mm, report.corner_3d_mm, report.leave_one_marker_out_mm
    edge, parallax, sigma = report.edge_length_mm, report.parallax_removed_mm, report.sigma_mm
    yield Number(own("corner_2d_mean", "2D corner error, mean"), flat.mean, MILLIMETRE)
    yield Number(own("corner_2d_sd", "2D corner error, SD"), flat.std, MILLIMETRE)
    yield Number(own("corner_3d_median", "3D corner error, median"), high.median, MILLIMETRE)
    yield Number(own("corner_3d_q1", "3D corner error, lower quartile"), high.q1, MILLIMETRE)
    yield Number(own("corner_3d_q3", "3D corner error, upper quartile"), high.q3, MILLIMETRE)
    if left is not None:
        yield Number(own("left_out_median", "Leaving a marker out, error, median"), left.median, MILLIMETRE)
        yield Number(own("left_out_largest", "Leaving a marker out, error, largest"), left.maximum, MILLIMETRE)
    yield Number(own("sigma_median", "Stated SD of a point of the specimen, median"), sigma.median, MILLIMETRE)
    yield Number(own("sigma_p95", "Stated SD of a point of the specimen, 95th percentile"), sigma.p95, MILLIMETRE)
    yield Number(own("edge_known", "Marker edge, as given"), edge.expected, MILLIMETRE)
    yield Number(own("edge_mean", "Marker edge, measured, mean"), edge.mean, MILLIMETRE)
    yield Number(own("edge_sd", "Marker edge, measured, SD"), edge.std, MILLIMETRE)
    yield Number(own("parallax_median", "Between the two registration methods, median"), parallax.median, MILLIMETRE)
    yield Number(own("parallax_largest", "Between the two registration methods, largest"), parallax.maximum, MILLIMETRE)
    yield Number(own("photo_rms", "Corners in the photos, RMS"), report.reprojection_px.after, PIXELS)
    yield Number(own("cube_rms", "Corners in the cube, RMS"), report.cube_camera.reprojection_rms_px, PIXELS)
    yield Number(
        own("coverage", "Pixels between the markers with a point"), 100 * report.coverage.between_markers, PERCENT
    )
    yield Number(own("photos_used", "Photos used"), len(report.photos.used), NO_UNIT)
    yield Number(own("photos_given", "Photos given"), report.photos.given, NO_UNIT)
    yield Number(own("specimen_points", "Points of the specimen"), report.coverage.specimen_points, NO_UNIT)
    certificate = report.certificate
    if certificate is not None and certificate.total_mm is not None:
        seen = certificate.total_mm
        yield Number(own("seen_median", "Error seen with unused evidence, median"), seen.median, MILLIMETRE)
        yield Number(own("seen_p95", "Error seen with unused evidence, 95th percentile"), seen.p95, MILLIMETRE)


def corners_in_cube(report: Report, mm_per_px: float) -> list[Corner]:
    """Each marker's corner that was measured in the cube; none in reports of versions that did not keep them.

    ``mm_per_px``: of the cube's pixels in the markers' plane; see :func:`~specimap_core.report.maps.spacing_mm`.
    """
    seen = report.cube_corners
    if seen is None:
        return []
    found = []
    for marker, residuals in zip(seen.marker_ids, seen.residuals_px, strict=True):
        lengths = np.linalg.norm(np.array(residuals, float).reshape(4, 2), axis=1)
        found += [Corner(marker, k, float(px), float(px * mm_per_px)) for k, px in enumerate(lengths)]
    return [corner for corner in found if math.isfinite(corner.residual_mm)]


RESIDUAL_MM = own("corner_residual", "Corner in the cube, residual")
RESIDUAL_PX = own("corner_resid_px", "Corner in the cube, residual in pixels")
LEFT_OUT = own("marker_left_out", "Error at this marker when it is left out")
