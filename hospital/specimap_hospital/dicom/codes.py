"""Coded terms of the objects: standard ones where there is one, else those of the scheme 99SPECIMAP."""

from __future__ import annotations

from highdicom.sr import CodedConcept

SCHEME = "99SPECIMAP"
SPECIMEN_CONTAINER = CodedConcept("434711009", "SCT", "Specimen container")
SPECIMEN = CodedConcept("121027", "DCM", "Specimen")
DEVICE = CodedConcept("121007", "DCM", "Device")
IMAGING_PROCEDURE = CodedConcept("363679005", "SCT", "Imaging procedure")
"""PixelMed's validator takes no private code for the procedure."""
ENGLISH = CodedConcept("en-GB", "RFC5646", "English (United Kingdom)")
QUALITATIVE_EVALUATIONS = CodedConcept("C0034375", "UMLS", "Qualitative Evaluations")
OF_INTEREST = CodedConcept("113000", "DCM", "Of Interest")
CONCEPT = CodedConcept("309825002", "SCT", "Spatial and Relational Concept")

MILLIMETRE = CodedConcept("mm", "UCUM", "mm")
MICROMETRE = CodedConcept("um", "UCUM", "um")
PIXELS = CodedConcept("{pixels}", "UCUM", "pixels")
PERCENT = CodedConcept("%", "UCUM", "%")
COUNTS = CodedConcept("{counts}", "UCUM", "counts")
NO_UNIT = CodedConcept("1", "UCUM", "no units")


def own(value: str, meaning: str) -> CodedConcept:
    """A term of Specimap's own; ``value`` has at most 16 characters, ``meaning`` 64."""
    return CodedConcept(value, SCHEME, meaning)


VERDICT = own("verdict", "Verdict of the accuracy report")
VERDICTS = {
    "good": own("verdict_good", "Holds what can be expected"),
    "note": own("verdict_note", "Holds what can be expected, with warnings"),
    "attention": own("verdict_look", "Look before use"),
}
"""By the level of the report's verdict."""
LIMITS_OF_USE = own("limits_of_use", "Limits of use")
SUMMARY = own("summary", "Summary")
ACTION = own("action", "What to do")
WARNING = own("warning", "Warning")
CHECK = own("check", "Check that failed")
NOT_IN_STUDY = own("not_in_study", "Not in this study")
MARKER_LAYOUT = own("marker_layout", "Printed markers around the specimen")
MARKER = own("marker", "Printed marker")
MARKER_CORNER = own("marker_corner", "Corner of a printed marker")
CLASSIFICATION = own("classification", "Classification of points, by a program or a person")
