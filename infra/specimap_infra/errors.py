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


class SyslogUnavailableError(SpecimapError, RuntimeError):
    """The syslog server cannot be reached, or did not take what it was sent."""

    code = "syslog_unavailable"


class LegalHoldError(SpecimapError, PermissionError):
    """A legal hold keeps the acquisition from being deleted, whoever asks; ``details['acquisition_id']``."""

    code = "legal_hold"
