"""Tables of the database. Rows that belong to an acquisition or a job are deleted with it."""

from __future__ import annotations

from specimap_infra.tables.access import ApiKey, Project, Share, SignIn
from specimap_infra.tables.acquisitions import Acquisition, StoredFile, Upload, UploadPart
from specimap_infra.tables.audit import AuditCursor, AuditEntry, AuditHead
from specimap_infra.tables.base import Base, UtcDateTime
from specimap_infra.tables.clouds import CloudRow, Export, LabelVersion
from specimap_infra.tables.fhir import FhirNotice
from specimap_infra.tables.hospital import DicomInstance, DicomSet, ReceivedStudy, SealedStudy
from specimap_infra.tables.jobs import Artefact, Delivery, Job, JobEvent, Lease, RepeatableRequest
from specimap_infra.tables.names import DICOM_STATES, FINAL_STATES, JOB_STATES, PRIORITIES, QUEUED, ROLES, SCOPES
from specimap_infra.tables.people import Person, SignInAttempt
from specimap_infra.tables.privacy import Erasure, LegalHold

__all__ = [
    "DICOM_STATES",
    "FINAL_STATES",
    "JOB_STATES",
    "PRIORITIES",
    "QUEUED",
    "ROLES",
    "SCOPES",
    "Acquisition",
    "ApiKey",
    "Artefact",
    "AuditCursor",
    "AuditEntry",
    "AuditHead",
    "Base",
    "CloudRow",
    "Delivery",
    "DicomInstance",
    "DicomSet",
    "Erasure",
    "Export",
    "FhirNotice",
    "Job",
    "JobEvent",
    "LabelVersion",
    "Lease",
    "LegalHold",
    "Person",
    "Project",
    "ReceivedStudy",
    "RepeatableRequest",
    "SealedStudy",
    "Share",
    "SignIn",
    "SignInAttempt",
    "StoredFile",
    "Upload",
    "UploadPart",
    "UtcDateTime",
]
