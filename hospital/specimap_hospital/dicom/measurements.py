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
from specimap_hospital.dicom.figures import Number, corners_in_cube, markers_left_out, summary
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
    """All markers with the summary, each marker, and each corner; a region without a number is none."""
    report = result.report
    settings = [f"method: {report.method}", f"backend: {report.backend}", f"adjustment: {report.adjustment}"]
    algorithm = AlgorithmIdentification(MANUFACTURER, header.source.software_version, settings)
    image = SourceImageForRegion.from_source_image(top_view)
    quads = result.canvas.pixels(result.corners.reshape(-1, 3)[:, :2]).reshape(-1, 4, 2) + _PIXEL_CENTRE

    def group(
        name: str, finding: CodedConcept, kind: GraphicTypeValues, at: Floats, numbers: Sequence[Number]
    ) -> PlanarROIMeasurementsAndQualitativeEvaluations:
        uid = derived_uid("region", header.instance_uid(MEASUREMENTS.role), name)
        return PlanarROIMeasurementsAndQualitativeEvaluations(
            tracking_identifier=TrackingIdentifier(uid=uid, identifier=name),
            referenced_region=ImageRegion(kind, at, image),
            finding_type=finding,
            algorithm_id=algorithm,
            measurements=[Measurement(number.name, _rounded(number.value), number.unit) for number in numbers],
        )

    outline, point = GraphicTypeValues.POLYLINE, GraphicTypeValues.POINT
    hull = cv2.convexHull(quads.reshape(-1, 2).astype(np.float32)).reshape(-1, 2).astype(float)
    groups = [group("All markers", codes.MARKER_LAYOUT, outline, _closed(hull), summary(report))]
    left_out, residuals = markers_left_out(report), corners_in_cube(report, spacing_mm(result.cloud))
    for marker, quad in zip(result.marker_ids, quads, strict=True):
        name = f"Marker {marker}"
        if marker in left_out:
            groups.append(group(name, codes.MARKER, outline, _closed(quad), [left_out[marker]]))
        for k, corner in enumerate(quad):
            if (marker, k) in residuals:
                at, numbers = corner[None], [residuals[marker, k]]
                groups.append(group(f"{name}, corner {k + 1}", codes.MARKER_CORNER, point, at, numbers))
    return groups


_PIXEL_CENTRE = 0.5
"""DICOM's image coordinates count from the top left corner of the top left pixel."""


def _closed(outline: Floats) -> Floats:
    """An outline (n, 2) that ends where it begins."""
    return np.concatenate([outline, outline[:1]])


def _rounded(value: float) -> float:
    """To four decimals: no more are shown, and viewers do not read exponents, in which small numbers are written."""
    return round(value, 4)


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
