"""The transaction that tells a FHIR server of a result: Specimen, ImagingStudy, Device, Observations, DiagnosticReport.

Sent again, it replaces its own observations and report, and makes nothing twice: these are found by their identifiers.
What the hospital may know already (specimen, study, device) is made only where there is none.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from urllib.parse import quote

from fhir.resources.R4B import get_fhir_model_class
from pydicom.dataset import Dataset

from specimap_hospital.fhir.elements import (
    DICOM_UID,
    Element,
    Systems,
    assigned_specimen,
    derived_uid,
    full_url,
    instant,
    oid,
    patient,
    service_request,
)
from specimap_hospital.fhir.errors import PatientMissingError
from specimap_hospital.fhir.observations import Shared, observations
from specimap_hospital.fhir.structured_report import measurement_groups
from specimap_infra.study_context import StudyContext

RESEARCH_USE = "For research use only; not for diagnosis."
_IMAGING = {"system": "http://terminology.hl7.org/CodeSystem/v2-0074", "code": "IMG", "display": "Diagnostic Imaging"}
_REPORT = {
    "system": "http://dicom.nema.org/resources/ontology/DCM",
    "code": "126000",
    "display": "Imaging Measurement Report",
}


@dataclass(frozen=True)
class SentInstance:
    """A DICOM instance of the result, by which ImagingStudy names it."""

    series_uid: str
    instance_uid: str
    sop_class_uid: str
    modality: str


@dataclass(frozen=True)
class Result:
    """What a bundle tells of. ``specimen_id``: the acquisition's, for contexts that name none."""

    cloud_id: str
    specimen_id: str
    captured_at: datetime.datetime
    finished_at: datetime.datetime
    software_version: str
    verdict: str
    """A sentence on how far the result can be trusted."""
    study_uid: str
    specimen_uid: str
    report: Dataset
    """The structured report (TID 1500)."""
    instances: Sequence[SentInstance]
    """Those that an archive has; without any there is no imaging study to refer to."""
    links: Sequence[str] = ()
    """Addresses at which a person finds the result."""


def transaction(context: StudyContext, result: Result, systems: Systems) -> Element:
    """Make the bundle, checked against the models of FHIR R4B, which agree with R4 in these resources.

    Raises:
        PatientMissingError: the context has no patient id.
        StructuredReportError: the report does not read.
    """
    if not context.patient_id:
        raise PatientMissingError(
            "The study context names no patient.", advice="Enter the patient's id in the study context, or look it up."
        )
    report_uid = str(result.report.SOPInstanceUID)
    urls = {name: full_url(name, result.study_uid, result.cloud_id) for name in ("Specimen", "ImagingStudy", "Device")}
    about: Element = {
        "subject": patient(context, systems),
        "effectiveDateTime": instant(result.captured_at),
        "issued": instant(result.finished_at),
        "status": "preliminary",
    }
    if context.accession_number:
        about["basedOn"] = [service_request(context, systems)]
    studies = [{"reference": urls["ImagingStudy"]}] if result.instances else []
    made_of = {"device": {"reference": urls["Device"]}, "specimen": {"reference": urls["Specimen"]}}
    in_study: Element = {"partOf": studies, "derivedFrom": studies} if studies else {}
    of_observations = Shared(report_uid, about | made_of | in_study)
    made, groups = observations(measurement_groups(result.report), of_observations)
    report: Element = {
        "resourceType": "DiagnosticReport",
        "identifier": [{"system": DICOM_UID, "value": oid(report_uid)}],
        **about,
        "category": [{"coding": [_IMAGING]}],
        "code": {"coding": [_REPORT], "text": "Spectral map of a specimen's surface"},
        "specimen": [{"reference": urls["Specimen"]}],
        **({"imagingStudy": studies} if studies else {}),
        "result": [{"reference": url} for url in groups],
        "conclusion": f"{result.verdict} {RESEARCH_USE}".strip(),
    }
    if result.links:
        report["presentedForm"] = [{"contentType": "text/html", "url": link} for link in result.links]
    specimen = _specimen(context, result, systems)
    device = _device(result)
    entries = [_create(urls["Specimen"], specimen, _token(specimen))]
    if studies:
        found = _imaging_study(context, result, systems)
        entries.append(_create(urls["ImagingStudy"], found, (DICOM_UID, oid(result.study_uid))))
    entries += [
        _create(urls["Device"], device, _token(device)),
        *(_update(item.url, item.resource, (DICOM_UID, oid(item.uid))) for item in made),
        _update(full_url("DiagnosticReport", report_uid), report, (DICOM_UID, oid(report_uid))),
    ]
    bundle: Element = {"resourceType": "Bundle", "type": "transaction", "entry": entries}
    get_fhir_model_class("Bundle").model_validate(bundle)
    return bundle


def _specimen(context: StudyContext, result: Result, systems: Systems) -> Element:
    assigned = assigned_specimen(
        context.specimen_identifier or result.specimen_id, context.issuer_of_specimen_identifier, systems
    )
    resource: Element = {
        "resourceType": "Specimen",
        "identifier": [assigned, {"system": DICOM_UID, "value": oid(result.specimen_uid)}],
        "subject": patient(context, systems),
        "type": {"coding": [{"system": "http://snomed.info/sct", "code": "119376003", "display": "Tissue specimen"}]},
    }
    if context.specimen_description:
        resource["note"] = [{"text": context.specimen_description}]
    if context.container_identifier:
        container = assigned_specimen(context.container_identifier, context.issuer_of_container_identifier, systems)
        resource["container"] = [{"identifier": [container]}]
    if context.accession_number:
        resource["request"] = [service_request(context, systems)]
    return resource


def _imaging_study(context: StudyContext, result: Result, systems: Systems) -> Element:
    series: dict[str, list[SentInstance]] = {}
    for instance in result.instances:
        series.setdefault(instance.series_uid, []).append(instance)
    resource: Element = {
        "resourceType": "ImagingStudy",
        "identifier": [{"system": DICOM_UID, "value": oid(result.study_uid)}],
        "status": "available",
        "subject": patient(context, systems),
        "started": instant(result.captured_at),
        "numberOfSeries": len(series),
        "numberOfInstances": len(result.instances),
        "series": [
            {
                "uid": uid,
                "modality": {"system": "http://dicom.nema.org/resources/ontology/DCM", "code": members[0].modality},
                "numberOfInstances": len(members),
                "instance": [
                    {
                        "uid": member.instance_uid,
                        "sopClass": {"system": "urn:ietf:rfc:3986", "code": oid(member.sop_class_uid)},
                    }
                    for member in members
                ],
            }
            for uid, members in series.items()
        ],
    }
    if context.accession_number:
        resource["basedOn"] = [service_request(context, systems)]
    return resource


def _device(result: Result) -> Element:
    return {
        "resourceType": "Device",
        "identifier": [{"system": DICOM_UID, "value": oid(derived_uid("device", result.software_version))}],
        "deviceName": [{"name": "Specimap", "type": "manufacturer-name"}],
        "version": [{"value": result.software_version}],
        "note": [{"text": RESEARCH_USE}],
    }


def _token(resource: Element) -> tuple[str, str]:
    """Return the identifier by which a server finds the resource: the first one that is unique beyond the hospital."""
    identifiers = resource["identifier"]
    assert isinstance(identifiers, list)
    return next((item["system"], item["value"]) for item in identifiers if "system" in item)


def _query(token: tuple[str, str]) -> str:
    return "identifier=" + quote("|".join(token), safe="")


def _create(url: str, resource: Element, token: tuple[str, str]) -> Element:
    kind = str(resource["resourceType"])
    return {
        "fullUrl": url,
        "resource": resource,
        "request": {"method": "POST", "url": kind, "ifNoneExist": _query(token)},
    }


def _update(url: str, resource: Element, token: tuple[str, str]) -> Element:
    kind = str(resource["resourceType"])
    return {"fullUrl": url, "resource": resource, "request": {"method": "PUT", "url": f"{kind}?{_query(token)}"}}
