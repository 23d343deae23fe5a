"""Elements that the resources have in common: codes, identifiers, references by identifier."""

from __future__ import annotations

import datetime
import re
import uuid
from dataclasses import dataclass
from typing import Any

from specimap_hospital.fhir.structured_report import Code
from specimap_infra.study_context import StudyContext

Element = dict[str, Any]
UCUM = "http://unitsofmeasure.org"
DCM = "http://dicom.nema.org/resources/ontology/DCM"
SCT = "http://snomed.info/sct"
DICOM_UID = "urn:dicom:uid"
IDENTIFIER_TYPE = "http://hl7.org/fhir/uv/dicom-sr/CodeSystem/dicom-identifier-type"
_SYSTEMS = {"DCM": DCM, "SCT": SCT, "LN": "http://loinc.org", "UCUM": UCUM, "RADLEX": "http://radlex.org"}
_NAMESPACE = uuid.UUID("6f7d5c0e-5d7e-5b0c-9a55-3b8f0a7b7f1e")
_OID = re.compile(r"^[012](\.(0|[1-9]\d*))+$")


@dataclass(frozen=True)
class Systems:
    """URIs of the hospital's own identifiers, where it has any: of patients, orders (accession numbers), specimens."""

    patient: str = ""
    accession: str = ""
    specimen: str = ""


def full_url(*names: str) -> str:
    """Return the ``urn:uuid:`` of a resource within its bundle, the same for the same names."""
    return f"urn:uuid:{uuid.uuid5(_NAMESPACE, '/'.join(names))}"


def oid(uid: str) -> str:
    """Write a DICOM UID as the value of an identifier of the system ``urn:dicom:uid``."""
    return f"urn:oid:{uid}"


def derived_uid(*names: str) -> str:
    """Return a UID (``2.25.`` and a UUID as a number), the same for the same names."""
    return f"2.25.{uuid.uuid5(_NAMESPACE, '/'.join(names)).int}"


def concept(code: Code) -> Element:
    """Write a code as a CodeableConcept; a scheme without a known URI is written as text alone."""
    coding = _coding(code)
    return {"coding": [coding], "text": code.meaning} if coding else {"text": code.meaning or code.value}


def quantity(value: float, unit: Code) -> Element:
    """Write a measured value with its unit in UCUM."""
    written: Element = {"value": value, "unit": unit.meaning or unit.value}
    if unit.scheme == "UCUM" and unit.value:
        written |= {"system": UCUM, "code": unit.value}
    return written


def observation_identifier(uid: str) -> Element:
    """Write the identifier of an observation of a structured report."""
    kind = {"coding": [{"system": IDENTIFIER_TYPE, "code": "observation-uid", "display": "Observation UID"}]}
    return {"type": kind, "system": DICOM_UID, "value": oid(uid)}


def patient(context: StudyContext, systems: Systems) -> Element:
    """Refer to the patient by identifier: the server knows its patients, and none is made here."""
    return {
        "type": "Patient",
        "identifier": _assigned(context.patient_id, systems.patient, context.issuer_of_patient_id),
    }


def service_request(context: StudyContext, systems: Systems) -> Element:
    """Refer to the order by its accession number."""
    identifier = _assigned(context.accession_number, systems.accession, context.issuer_of_accession_number)
    identifier["type"] = {"coding": [{"system": "http://terminology.hl7.org/CodeSystem/v2-0203", "code": "ACSN"}]}
    return {"type": "ServiceRequest", "identifier": identifier}


def assigned_specimen(value: str, issuer: str, systems: Systems) -> Element:
    """Write the identifier of a specimen or its container."""
    return _assigned(value, systems.specimen, issuer)


def instant(at: datetime.datetime) -> str:
    """Write a time of a known zone."""
    return at.astimezone(datetime.UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _assigned(value: str, system: str, issuer: str) -> Element:
    identifier: Element = {"value": value}
    if system:
        identifier["system"] = system
    elif _OID.match(issuer):
        identifier["system"] = oid(issuer)
    elif issuer.startswith(("http://", "https://", "urn:")):
        identifier["system"] = issuer
    if issuer and identifier.get("system") not in (issuer, oid(issuer)):
        identifier["assigner"] = {"display": issuer}
    return identifier


def _coding(code: Code) -> Element | None:
    system = _SYSTEMS.get(code.scheme)
    if system is None or not code.value:
        return None
    return {"system": system, "code": code.value, "display": code.meaning or code.value}
