"""Study contexts, keys and results for tests of the hospital's side. All names are obviously made up."""

from __future__ import annotations

import datetime
from typing import Any

from specimap_infra.study_context import StudyContext
from specimap_infra.study_keys import new_key

KEY = new_key()
PATIENT = StudyContext(
    accession_number="ACC4711",
    patient_id="PID-0815-XYZ",
    patient_name="Doe^Jane^Quasimodo",
    patient_birth_date=datetime.date(1951, 2, 3),
    patient_sex="F",
    referring_physician_name="Strange^Stephen",
    study_description="Excision of the left Quux",
    container_identifier="CONT-99",
    specimen_identifier="SPEC-77",
)
PLANTED = ("ACC4711", "PID-0815-XYZ", "Quasimodo", "1951-02-03", "19510203", "Strange^Stephen", "left Quux")
"""Texts that may stand nowhere in clear."""


def as_json(context: StudyContext = PATIENT) -> dict[str, Any]:
    """What a client sends."""
    return context.model_dump(mode="json", exclude_defaults=True)
