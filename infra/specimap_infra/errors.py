"""Errors of jobs, the database and the storage, which the API and the workers share."""

from __future__ import annotations

from specimap_core.errors import SpecimapError


class JobConflictError(SpecimapError, ValueError):
    """The state of the job or acquisition does not allow the request."""

    code = "state_conflict"


class LostLeaseError(SpecimapError, RuntimeError):
    """A worker wrote to a job that is no longer its own: cancelled, ended, or taken over by another."""

    code = "lost_lease"


class WorkerCrashedError(SpecimapError, RuntimeError):
    """The job's process or its workers died again and again; ``details`` name the ``stage`` and the ``cause``."""

    code = "worker_crashed"


class StageTimeoutError(SpecimapError, RuntimeError):
    """A stage took longer than its limit and was stopped."""

    code = "stage_timeout"


class StorageUnavailableError(SpecimapError, RuntimeError):
    """The storage cannot be reached, read or written."""

    code = "storage_unavailable"


class DatabaseUnavailableError(SpecimapError, RuntimeError):
    """The database cannot be reached."""

    code = "database_unavailable"


class DatabaseDamagedError(SpecimapError, RuntimeError):
    """The file of a SQLite database is none, or a damaged one."""

    code = "database_damaged"


class DatabaseTooNewError(SpecimapError, RuntimeError):
    """A newer release has brought the database to its schema; ``details['version']``."""

    code = "database_too_new"


class BackupInvalidError(SpecimapError, ValueError):
    """A backup is not whole, not as it was made, or of a newer release."""

    code = "backup_invalid"


class RestoreTargetError(SpecimapError, FileExistsError):
    """A backup would be restored over data."""

    code = "restore_target_not_empty"


class StudyKeysMissingError(SpecimapError, RuntimeError):
    """No key to encrypt study contexts with is set, so none is kept."""

    code = "study_keys_missing"


class StudySealedError(SpecimapError, RuntimeError):
    """A study context does not open: its key is no longer set, or its row was changed."""

    code = "study_sealed"


class StudyMissingError(SpecimapError, ValueError):
    """The acquisition has no study context, which DICOM objects of its results need."""

    code = "study_missing"


class OrderSourceMissingError(SpecimapError, ValueError):
    """No worklist and no other source of orders is set."""

    code = "order_source_missing"


class OrderSourceUnavailableError(SpecimapError, RuntimeError):
    """The source of orders does not answer, refuses, or answers what does not read; ``details['source']`` names it."""

    code = "order_source_unavailable"


class FhirServerMissingError(SpecimapError, ValueError):
    """A result is to be told to a FHIR server, and none is set."""

    code = "fhir_server_missing"


class ArchiveMissingError(SpecimapError, ValueError):
    """No archive to send DICOM objects to is set."""

    code = "archive_missing"


class SyslogUnavailableError(SpecimapError, RuntimeError):
    """The syslog server cannot be reached, or did not take what it was sent."""

    code = "syslog_unavailable"


class LegalHoldError(SpecimapError, PermissionError):
    """A legal hold keeps the acquisition from being deleted, whoever asks; ``details['acquisition_id']``."""

    code = "legal_hold"
