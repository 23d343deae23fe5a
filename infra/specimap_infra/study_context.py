"""The study context of an acquisition: the order, patient and specimen that its DICOM objects belong to.

The only place of the program that holds patient data. It is kept encrypted, and appears in no log, event, file name or
array.
"""

from __future__ import annotations

import datetime
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator
from pydantic_core import PydanticCustomError

_NO_CONTROL = r"^[^\x00-\x1f\x7f\\]*$"
ShortText = Annotated[str, StringConstraints(strip_whitespace=True, max_length=16, pattern=_NO_CONTROL)]
"""DICOM's SH."""
Text = Annotated[str, StringConstraints(strip_whitespace=True, max_length=64, pattern=_NO_CONTROL)]
"""DICOM's LO, and a component group of PN."""
Uid = Annotated[str, StringConstraints(max_length=64, pattern=r"^(0|[1-9]\d*)(\.(0|[1-9]\d*))+$")]


class StudyContext(BaseModel):
    """What an order says, or a person entered. Attribute names follow DICOM's keywords."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        json_schema_extra={
            "example": {"accession_number": "A-2026-0117", "patient_id": "0000001", "patient_name": "Doe^Jane"}
        },
    )

    study_instance_uid: Uid | None = Field(default=None, description="The order's own study; without it one is made.")
    accession_number: ShortText = ""
    issuer_of_accession_number: Text = ""
    patient_id: Text = ""
    issuer_of_patient_id: Text = ""
    patient_name: Text = Field(default="", description="`Family^Given^Middle^Prefix^Suffix`.")
    patient_birth_date: datetime.date | None = None
    patient_sex: Literal["", "M", "F", "O"] = ""
    referring_physician_name: Text = ""
    study_id: ShortText = ""
    study_description: Text = ""
    study_date: datetime.date | None = None
    study_time: datetime.time | None = None
    requested_procedure_id: ShortText = ""
    scheduled_procedure_step_id: ShortText = ""
    container_identifier: Text = Field(default="", description="Of the container of the specimen; by default its id.")
    issuer_of_container_identifier: Text = ""
    specimen_identifier: Text = Field(default="", description="By default the specimen's id of the acquisition.")
    issuer_of_specimen_identifier: Text = ""
    specimen_uid: Uid | None = None
    specimen_description: Text = ""

    @model_validator(mode="before")
    @classmethod
    def _known_fields(cls, values: Any) -> Any:
        # The name of a field that is none would stand in the error, and it may be a patient's.
        if isinstance(values, dict) and not values.keys() <= cls.model_fields.keys():
            raise PydanticCustomError("unknown_field", "It has a field that a study context does not have")
        return values
