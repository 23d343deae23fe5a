"""Coded terms of the objects: standard ones where there is one, else those of the scheme 99SPECIMAP."""

from __future__ import annotations

from highdicom.sr import CodedConcept

SPECIMEN_CONTAINER = CodedConcept("434711009", "SCT", "Specimen container")
MILLIMETRE = CodedConcept("mm", "UCUM", "mm")
