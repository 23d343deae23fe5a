"""A structured report as highdicom writes it, a context, and the bundle made of them."""

from __future__ import annotations

import datetime

import highdicom as hd
import numpy as np
from highdicom.sr import (
    AlgorithmIdentification,
    CodedConcept,
    Comprehensive3DSR,
    GraphicTypeValues,
    ImageRegion,
    Measurement,
    MeasurementReport,
    ObservationContext,
    ObserverContext,
    PersonObserverIdentifyingAttributes,
    PlanarROIMeasurementsAndQualitativeEvaluations,
    QualitativeEvaluation,
    SourceImageForRegion,
    TrackingIdentifier,
)
from pydicom.dataset import Dataset
from pydicom.sr.codedict import codes

from specimap_hospital.fhir.bundle import Result, SentInstance
from specimap_infra.study_context import StudyContext

WHEN = datetime.datetime(2026, 3, 1, 9, 30, tzinfo=datetime.UTC)
STUDY = "1.2.826.0.1.3680043.9.7.1"
PHOTOGRAPH = "1.2.840.10008.5.1.4.1.1.77.1.4"
VALUES = {"Mean corner error": 0.0123, "SD corner error": 0.0045}
CONTEXT = StudyContext(
    study_instance_uid=STUDY,
    accession_number="ACC-1",
    patient_id="PID-7",
    issuer_of_patient_id="urn:example:patients",
    patient_name="Doe^Jane",
    specimen_identifier="SP-1",
    container_identifier="BOX-1",
    specimen_description="Lumpectomy, left",
)


def report(uid: str = "1.2.826.0.1.3680043.9.7.2.1") -> Dataset:
    """A TID 1500 report with one planar group: two measurements and one evaluation."""
    image = Dataset()
    image.SOPClassUID, image.SOPInstanceUID = "1.2.840.10008.5.1.4.1.1.7", "1.2.826.0.1.3680043.9.7.3"
    image.StudyInstanceUID, image.SeriesInstanceUID = STUDY, "1.2.826.0.1.3680043.9.7.4"
    image.PatientID, image.PatientName, image.PatientBirthDate, image.PatientSex = "PID-7", "Doe^Jane", "", ""
    image.AccessionNumber, image.StudyID, image.StudyDate, image.StudyTime = "ACC-1", "", "", ""
    image.ReferringPhysicianName = ""
    region = ImageRegion(
        graphic_type=GraphicTypeValues.POLYLINE,
        graphic_data=np.array([[1.0, 1.0], [5.0, 1.0], [5.0, 5.0], [1.0, 1.0]]),
        source_image=SourceImageForRegion(image.SOPClassUID, image.SOPInstanceUID),
    )
    group = PlanarROIMeasurementsAndQualitativeEvaluations(
        tracking_identifier=TrackingIdentifier(uid="1.2.826.0.1.3680043.9.7.5", identifier="Marker corners"),
        referenced_region=region,
        measurements=[
            Measurement(CodedConcept(name, "99SPECIMAP", name), value, codes.UCUM.Millimeter)
            for name, value in VALUES.items()
        ],
        qualitative_evaluations=[
            QualitativeEvaluation(
                CodedConcept("verdict", "99SPECIMAP", "Verdict"), CodedConcept("ok", "99SPECIMAP", "Trustworthy")
            )
        ],
        algorithm_id=AlgorithmIdentification(name="Specimap", version="0.1.0"),
    )
    observer = ObserverContext(codes.DCM.Person, PersonObserverIdentifyingAttributes(name="Doe^John"))
    content = MeasurementReport(
        observation_context=ObservationContext(observer_person_context=observer),
        procedure_reported=codes.SCT.ImagingProcedure,
        imaging_measurements=[group],
    )
    return Comprehensive3DSR(
        evidence=[image],
        content=content,
        series_instance_uid=hd.UID(),
        series_number=9,
        sop_instance_uid=uid,
        instance_number=1,
        manufacturer="Specimap",
    )


def result(document: Dataset | None = None) -> Result:
    """A result with that report."""
    return Result(
        cloud_id="cloud_01",
        specimen_id="specimen-1",
        captured_at=WHEN,
        finished_at=WHEN + datetime.timedelta(minutes=5),
        software_version="0.1.0",
        verdict="The figures can be trusted.",
        study_uid=STUDY,
        specimen_uid="1.2.826.0.1.3680043.9.7.6",
        report=document if document is not None else report(),
        instances=[SentInstance("1.2.826.0.1.3680043.9.7.4", "1.2.826.0.1.3680043.9.7.3", PHOTOGRAPH, "XC")],
        links=["https://specimap.example/#/view/cloud_01"],
    )
