"""Tables of the database. Rows that belong to an acquisition or a job are deleted with it."""

from __future__ import annotations

from specimap_infra.tables.access import ApiKey, AuditEntry, Project, Share, SignIn
from specimap_infra.tables.acquisitions import Acquisition, StoredFile, Upload, UploadPart
from specimap_infra.tables.base import Base, UtcDateTime
from specimap_infra.tables.clouds import CloudRow, Export, LabelVersion
from specimap_infra.tables.hospital import DicomInstance, DicomSet, ReceivedStudy, SealedStudy
from specimap_infra.tables.jobs import Artefact, Delivery, Job, JobEvent, Lease, RepeatableRequest
from specimap_infra.tables.names import DICOM_STATES, FINAL_STATES, JOB_STATES, PRIORITIES, QUEUED, ROLES, SCOPES

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
    "AuditEntry",
    "Base",
    "CloudRow",
    "Delivery",
    "DicomInstance",
    "DicomSet",
    "Export",
    "Job",
    "JobEvent",
    "LabelVersion",
    "Lease",
    "Project",
    "ReceivedStudy",
    "RepeatableRequest",
    "SealedStudy",
    "Share",
    "SignIn",
    "StoredFile",
    "Upload",
    "UploadPart",
    "UtcDateTime",
]
