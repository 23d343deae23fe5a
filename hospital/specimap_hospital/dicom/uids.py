"""UIDs that follow from a result's ids, so that an object sent again is the same object."""

from __future__ import annotations

import uuid

from specimap_hospital.dicom.model import ResultSource
from specimap_infra.study_context import StudyContext

_NAMESPACE = uuid.UUID("5a3c8c0e-41c1-5d0f-9b1e-6f0d0e8a7c31")
REVISION = 1
"""Part of each instance's UID. Raise it when the objects of an unchanged result come out otherwise: an archive may keep
either of two different objects with one UID."""


def derived_uid(*parts: str) -> str:
    """The UID of a name, in the root 2.25 (a name-based UUID as a number). The parts hold no patient data."""
    return f"2.25.{uuid.uuid5(_NAMESPACE, '/'.join(parts)).int}"


IMPLEMENTATION_CLASS_UID = derived_uid("implementation")
"""Of the program that wrote a file."""


def study_uid(context: StudyContext, source: ResultSource) -> str:
    """The order's own study, or one of the acquisition."""
    return context.study_instance_uid or derived_uid("study", source.acquisition_id)
