"""Errors of the service and its workers, and the one table that gives every leaf its HTTP status (RFC 9457)."""

from __future__ import annotations

from specimap.core import errors as core
from specimap.core.errors import SpecimapError


class UnauthorizedError(SpecimapError, PermissionError):
    """No key, or one that is unknown, expired or revoked."""

    code = "unauthorized"


class ForbiddenError(SpecimapError, PermissionError):
    """The key is valid but lacks the scope; ``details['scope']`` names it."""

    code = "forbidden"


class RateLimitedError(SpecimapError, RuntimeError):
    """More requests than the key may make; ``details['retry_after_s']`` says when to come back."""

    code = "rate_limited"


class RequestInvalidError(SpecimapError, ValueError):
    """The request's body, path or query does not fit the contract; details list the fields."""

    code = "request_invalid"


class MethodNotAllowedError(SpecimapError, ValueError):
    """The address exists, but not for this method."""

    code = "method_not_allowed"


class PayloadTooLargeError(SpecimapError, ValueError):
    """A body or a file is larger than the service takes; ``details['limit_bytes']``."""

    code = "payload_too_large"


class QuotaExceededError(SpecimapError, ValueError):
    """The key's quota of stored bytes or files is used up."""

    code = "quota_exceeded"


class UploadIncompleteError(SpecimapError, ValueError):
    """A job was asked for before all its files had arrived; details say what is missing."""

    code = "upload_incomplete"


class UploadConflictError(SpecimapError, ValueError):
    """The upload's offset, length or checksum is not what the client says."""

    code = "upload_conflict"


class ChecksumMismatchError(SpecimapError, ValueError):
    """What arrived does not have the checksum that came with it; nothing of it was kept."""

    code = "checksum_mismatch"


class UploadLockedError(SpecimapError, RuntimeError):
    """Another request is writing to the same upload."""

    code = "upload_locked"


class UploadGoneError(SpecimapError, FileNotFoundError):
    """The upload expired or was ended; ``details['state']`` says which."""

    code = "upload_gone"


class JobConflictError(SpecimapError, ValueError):
    """The job's or acquisition's state does not allow what was asked."""

    code = "state_conflict"


class IdempotencyConflictError(SpecimapError, ValueError):
    """The idempotency key was used before, with another request."""

    code = "idempotency_conflict"


class PreconditionFailedError(SpecimapError, ValueError):
    """What is stored is not what the request's If-Match names."""

    code = "precondition_failed"


class RangeNotSatisfiableError(SpecimapError, ValueError):
    """The byte range lies outside of the file; ``details['size']`` is the file's."""

    code = "range_not_satisfiable"


class NotAcceptableError(SpecimapError, ValueError):
    """The answer does not exist in any media type that the request accepts; ``details['offered']`` lists them."""

    code = "not_acceptable"


class MediaTypeError(SpecimapError, ValueError):
    """The body is of a media type that the operation does not take; ``details['offered']`` lists those it does."""

    code = "media_type_unsupported"


class LostLeaseError(SpecimapError, RuntimeError):
    """A worker wrote to a job that is not its own any more: cancelled, ended, or taken over by another."""

    code = "lost_lease"


class WorkerCrashedError(SpecimapError, RuntimeError):
    """The job's process died again and again; ``details['stage']`` says where."""

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


HTTP_STATUS: dict[type[SpecimapError], int] = {
    **core.HTTP_STATUS,
    ChecksumMismatchError: 460,
    DatabaseUnavailableError: 503,
    ForbiddenError: 403,
    IdempotencyConflictError: 409,
    JobConflictError: 409,
    LostLeaseError: 409,
    MediaTypeError: 415,
    MethodNotAllowedError: 405,
    NotAcceptableError: 406,
    PayloadTooLargeError: 413,
    PreconditionFailedError: 412,
    QuotaExceededError: 413,
    RangeNotSatisfiableError: 416,
    RateLimitedError: 429,
    RequestInvalidError: 422,
    StageTimeoutError: 500,
    StorageUnavailableError: 503,
    UnauthorizedError: 401,
    UploadConflictError: 409,
    UploadGoneError: 410,
    UploadIncompleteError: 409,
    UploadLockedError: 423,
    WorkerCrashedError: 500,
}


def status_of(error: SpecimapError) -> int:
    """HTTP status of an error: its own, or that of the nearest class above it."""
    return next(HTTP_STATUS[leaf] for leaf in type(error).__mro__ if leaf in HTTP_STATUS)
