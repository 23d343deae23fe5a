"""Errors of the notification by FHIR."""

from __future__ import annotations

from specimap_core.errors import SpecimapError


class StructuredReportError(SpecimapError, ValueError):
    """A data set is not a measurement report of TID 1500."""

    code = "structured_report_invalid"


class PatientMissingError(SpecimapError, ValueError):
    """The study context names no patient, whom a diagnostic report is about."""

    code = "patient_missing"


class FhirRefusedError(SpecimapError, ValueError):
    """The FHIR server refuses what was posted; ``details``: its ``status``, and the ``issues`` by their codes."""

    code = "fhir_refused"


class FhirUnavailableError(SpecimapError, RuntimeError):
    """The FHIR server, or the one that gives tokens for it, cannot be reached, or asks to come back later."""

    code = "fhir_unavailable"
