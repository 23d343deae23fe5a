"""Orders out of the data sets of a worklist, or of studies that QIDO-RS finds."""

from __future__ import annotations

import datetime
from typing import TYPE_CHECKING, Any, Literal

from pydantic import ValidationError

from specimap_hospital.orders.model import Order
from specimap_infra.study_context import StudyContext

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

IDENTITY = frozenset({"accession_number", "patient_id", "patient_name", "study_instance_uid", "patient_birth_date"})
"""Without one of these an order could be taken for another: it is left out where one does not read."""
LONGEST = 64


def order_of(found: Dataset, source: Literal["worklist", "qido"]) -> Order | None:
    """Make an order; None where who it is about does not read. What else does not read is left out."""
    step = _first(found, "ScheduledProcedureStepSequence")
    specimen = _first(step, "ScheduledSpecimenSequence") or _first(found, "ScheduledSpecimenSequence") or found
    described = _first(specimen, "SpecimenDescriptionSequence") or specimen
    procedure = _text(found, "RequestedProcedureDescription") or _text(found, "StudyDescription")
    step_text = _text(step, "ScheduledProcedureStepDescription")
    values: dict[str, Any] = {
        "study_instance_uid": _text(found, "StudyInstanceUID") or None,
        "accession_number": _text(found, "AccessionNumber"),
        "issuer_of_accession_number": _issuer(found, "IssuerOfAccessionNumberSequence"),
        "patient_id": _text(found, "PatientID"),
        "issuer_of_patient_id": _text(found, "IssuerOfPatientID"),
        "patient_name": _text(found, "PatientName").split("=")[0],
        "patient_birth_date": _date(_text(found, "PatientBirthDate")),
        "patient_sex": _text(found, "PatientSex"),
        "referring_physician_name": _text(found, "ReferringPhysicianName").split("=")[0],
        "study_id": _text(found, "StudyID"),
        "study_description": (procedure or step_text)[:LONGEST],
        "requested_procedure_id": _text(found, "RequestedProcedureID"),
        "scheduled_procedure_step_id": _text(step, "ScheduledProcedureStepID"),
        "container_identifier": _text(specimen, "ContainerIdentifier"),
        "issuer_of_container_identifier": _issuer(specimen, "IssuerOfTheContainerIdentifierSequence"),
        "specimen_identifier": _text(described, "SpecimenIdentifier"),
        "issuer_of_specimen_identifier": _issuer(described, "IssuerOfTheSpecimenIdentifierSequence"),
        "specimen_uid": _text(described, "SpecimenUID") or None,
        "specimen_description": _text(described, "SpecimenShortDescription"),
    }
    if source == "qido":
        values["study_date"] = _date(_text(found, "StudyDate"))
        values["study_time"] = _time(_text(found, "StudyTime"))
    study = _study(values)
    if study is None:
        return None
    day = _date(_text(step, "ScheduledProcedureStepStartDate") or _text(found, "StudyDate"))
    hour = _time(_text(step, "ScheduledProcedureStepStartTime") or _text(found, "StudyTime"))
    return Order(
        source=source,
        study=study,
        scheduled_at=None if day is None else datetime.datetime.combine(day, hour or datetime.time()),
        station=_text(step, "ScheduledStationAETitle")[:16],
        modality=_text(step, "Modality")[:16],
        description=(step_text or procedure)[:LONGEST],
    )


def _study(values: dict[str, Any]) -> StudyContext | None:
    try:
        return StudyContext.model_validate(values)
    except ValidationError as error:
        wrong = {str(found["loc"][0]) for found in error.errors() if found["loc"]}
    if not wrong or wrong & IDENTITY:
        return None
    return _study({name: value for name, value in values.items() if name not in wrong})


def _first(found: Dataset | None, keyword: str) -> Dataset | None:
    items = None if found is None else found.get(keyword)
    return items[0] if items else None


def _text(found: Dataset | None, keyword: str) -> str:
    value = None if found is None else found.get(keyword)
    if isinstance(value, (list, tuple)) or type(value).__name__ == "MultiValue":
        # Of several values none is known to be the right one; a backslash is in no value of a study context.
        value = "\\".join(str(item) for item in value or ())
    return "" if value is None else str(value).strip(" \0")


def _issuer(found: Dataset | None, keyword: str) -> str:
    item = _first(found, keyword)
    return _text(item, "LocalNamespaceEntityID") or _text(item, "UniversalEntityID")


def _date(text: str) -> datetime.date | None:
    try:
        return datetime.datetime.strptime(text[:10].replace("-", "")[:8], "%Y%m%d").date()
    except ValueError:
        return None


def _time(text: str) -> datetime.time | None:
    digits = text.replace(":", "").split(".")[0].ljust(6, "0")[:6]
    try:
        return datetime.datetime.strptime(digits, "%H%M%S").time() if text else None
    except ValueError:
        return None
