"""The accuracy figures as a structured report (TID 1500), with every number in a region of the top view.

Viewers show numbers in regions only. The summary lies on an outline around all markers, the residuals on their corners;
verdict, warnings and limits of use are in words beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import highdicom as hd
import numpy as np
from highdicom.sr import (
    AlgorithmIdentification,
    CodeContentItem,
    CodedConcept,
    ContainerContentItem,
    ContentSequence,
    DeviceObserverIdentifyingAttributes,
    GraphicTypeValues,
    ImageRegion,
    LanguageOfContentItemAndDescendants,
    Measurement,
    MeasurementReport,
    ObservationContext,
    ObserverContext,
    PlanarROIMeasurementsAndQualitativeEvaluations,
    RelationshipTypeValues,
    SourceImageForRegion,
    SubjectContext,
    SubjectContextSpecimen,
    TextContentItem,
    TrackingIdentifier,
)
from pydicom import Dataset
from pydicom.uid import ExplicitVRLittleEndian

from specimap_core.arrays import Floats
from specimap_core.report.maps import spacing_mm
from specimap_core.report.wording import UNKNOWN_WARNING_ADVICE, WARNING_ADVICE, checks, verdict
from specimap_hospital.dicom import codes
from specimap_hospital.dicom.figures import LEFT_OUT, RESIDUAL_MM, RESIDUAL_PX, Corner, corners_in_cube, summary
from specimap_hospital.dicom.files import Written, write_dataset
from specimap_hospital.dicom.header import MANUFACTURER, MEASUREMENTS, Header
from specimap_hospital.dicom.model import LeftOut
from specimap_hospital.dicom.result import Result
from specimap_hospital.dicom.uids import derived_uid

USE = "Research use only. Not a medical device; not validated for clinical decisions."
FRAME = "The regions lie on the top view, whose axes are those of the printed markers, not of the patient."


def write_measurements(
    header: Header, result: Result, top_view: Dataset, left_out: Sequence[LeftOut], target: Path
) -> Written:
    """Write the structured report on a result as the object ``target``; ``top_view``: the object that it refers to.

    Raises:
        StorageFullError, OutputNotWritableError: it cannot be written.
    """
    content = MeasurementReport(
        observation_context=_context(header),
        procedure_reported=codes.IMAGING_PROCEDURE,
        imaging_measurements=_groups(header, result, top_view),
        language_of_content_item_and_descendants=LanguageOfContentItemAndDescendants(codes.ENGLISH),
    )
    content[0].ContentSequence.append(_in_words(result, left_out))
    report = hd.sr.ComprehensiveSR(
        evidence=[top_view],
        content=content[0],
        series_instance_uid=header.series_uid(MEASUREMENTS),
        series_number=MEASUREMENTS.number,
        sop_instance_uid=header.instance_uid(MEASUREMENTS.role),
        instance_number=1,
        manufacturer=MANUFACTURER,
        is_complete=True,
        is_final=True,
        transfer_syntax_uid=ExplicitVRLittleEndian,
    )
    header.put(report, MEASUREMENTS, MEASUREMENTS.role, 1)
    return write_dataset(header, report, "measurements", target, ExplicitVRLittleEndian)


def _context(header: Header) -> ObservationContext:
    device = DeviceObserverIdentifyingAttributes(
        uid=header.device_uid, name=MANUFACTURER, manufacturer_name=MANUFACTURER, model_name=MANUFACTURER
    )
    specimen = SubjectContextSpecimen(
        uid=header.specimen_uid,
        identifier=header.specimen_identifier,
        container_identifier=header.container_identifier,
    )
    return ObservationContext(
        observer_device_context=ObserverContext(codes.DEVICE, device),
        subject_context=SubjectContext(codes.SPECIMEN, specimen),
    )


# ---- numbers ------------------------------------------------------------------------------------------


def _groups(header: Header, result: Result, top_view: Dataset) -> list[PlanarROIMeasurementsAndQualitativeEvaluations]:
    report, image = result.report, SourceImageForRegion.from_source_image(top_view)
    settings = [f"method: {report.method}", f"backend: {report.backend}", f"adjustment: {report.adjustment}"]
    algorithm = AlgorithmIdentification(MANUFACTURER, header.source.software_version, settings)
    around = result.canvas.pixels(result.corners.reshape(-1, 3)[:, :2])
    whole = PlanarROIMeasurementsAndQualitativeEvaluations(
        tracking_identifier=_tracking(header, "All markers"),
        referenced_region=ImageRegion(GraphicTypeValues.POLYLINE, _outline(around), image),
        finding_type=codes.MARKER_LAYOUT,
        algorithm_id=algorithm,
        measurements=[Measurement(number.name, _rounded(number.value), number.unit) for number in summary(report)],
    )
    place = {marker: k for k, marker in enumerate(result.marker_ids)}
    points = []
    for corner in corners_in_cube(report, spacing_mm(result.cloud)):
        if corner.marker in place:
            at = around.reshape(-1, 4, 2)[place[corner.marker], corner.corner]
            points.append(_point(header, result, corner, at, image, algorithm))
    return [whole, *points]


def _point(
    header: Header,
    result: Result,
    corner: Corner,
    at: Floats,
    image: SourceImageForRegion,
    algorithm: AlgorithmIdentification,
) -> PlanarROIMeasurementsAndQualitativeEvaluations:
    measured = [
        Measurement(RESIDUAL_MM, _rounded(corner.residual_mm), codes.MILLIMETRE),
        Measurement(RESIDUAL_PX, _rounded(corner.residual_px), codes.PIXELS),
    ]
    left = result.report.leave_one_marker_out_mm
    of_marker = left.per_marker.get(str(corner.marker), float("nan")) if left is not None else float("nan")
    if np.isfinite(of_marker):
        measured.append(Measurement(LEFT_OUT, _rounded(of_marker), codes.MILLIMETRE))
    return PlanarROIMeasurementsAndQualitativeEvaluations(
        tracking_identifier=_tracking(header, f"Marker {corner.marker}, corner {corner.corner + 1}"),
        referenced_region=ImageRegion(GraphicTypeValues.POINT, at.reshape(1, 2) + _PIXEL_CENTRE, image),
        finding_type=codes.MARKER_CORNER,
        algorithm_id=algorithm,
        measurements=measured,
    )


_PIXEL_CENTRE = 0.5
"""DICOM's image coordinates count from the top left corner of the top left pixel."""


def _outline(around: Floats) -> Floats:
    """The closed outline (n, 2) of points (m, 2): column, row."""
    hull = cv2.convexHull(around.astype(np.float32)).reshape(-1, 2).astype(float)
    return np.concatenate([hull, hull[:1]]) + _PIXEL_CENTRE


def _tracking(header: Header, name: str) -> TrackingIdentifier:
    return TrackingIdentifier(uid=derived_uid("region", header.instance_uid(MEASUREMENTS.role), name), identifier=name)


def _rounded(value: float) -> float:
    """To six significant digits: DICOM's decimal strings hold 16 characters."""
    return float(f"{value:.6g}")


# ---- words --------------------------------------------------------------------------------------------


def _in_words(result: Result, left_out: Sequence[LeftOut]) -> ContainerContentItem:
    """Limits of use, verdict, what to do, checks that failed, and warnings."""
    report = result.report
    judged = verdict(report)
    said: list[tuple[CodedConcept, str]] = [
        (codes.LIMITS_OF_USE, f"{USE} {FRAME}"),
        (codes.SUMMARY, " ".join([judged.title, *judged.sentences])),
        *((codes.ACTION, action) for action in judged.actions),
        *((codes.CHECK, f"{c.name}: {c.found}, wanted {c.wanted}.") for c in checks(report) if not c.good),
    ]
    for warning in report.warnings:
        advice = WARNING_ADVICE.get(warning.code, UNKNOWN_WARNING_ADVICE)
        said.append((codes.WARNING, f"{warning.code}: {warning.message} {advice}"))
    for photo in left_out:
        said.append((codes.NOT_IN_STUDY, f"Photo {photo.photo} could not be read ({photo.code})."))
    words = ContainerContentItem(
        name=codes.QUALITATIVE_EVALUATIONS,
        relationship_type=RelationshipTypeValues.CONTAINS,
        is_content_continuous=False,
    )
    words.ContentSequence = ContentSequence(
        [
            CodeContentItem(codes.VERDICT, codes.VERDICTS[judged.level], RelationshipTypeValues.CONTAINS),
            *(TextContentItem(name, text, RelationshipTypeValues.CONTAINS) for name, text in said),
        ]
    )
    return words
