"""The one table that gives each error its HTTP status (RFC 9457)."""

from __future__ import annotations

from specimap_core import errors as core
from specimap_core.errors import SpecimapError
from specimap_infra import errors as infra
from specimap_service import errors as service

HTTP_STATUS: dict[type[SpecimapError], int] = {
    core.SpecimapError: 500,
    core.BackendFailedError: 500,
    core.BackendUnavailableError: 503,
    core.CancelledError: 409,
    core.CloudDamagedError: 500,
    core.CubeContentError: 422,
    core.CubeFormatError: 415,
    core.CubeHeaderError: 422,
    core.CubeNotFoundError: 404,
    core.CubeNotReadableError: 403,
    core.CubeTruncatedError: 422,
    core.DepthNotFoundError: 422,
    core.DuplicateMarkersError: 422,
    core.EdgeImplausibleError: 422,
    core.LabelInvalidError: 422,
    core.MarkerGeometryError: 422,
    core.MarkersMissingInCubeError: 422,
    core.MemoryExhaustedError: 507,
    core.NoMarkersFoundError: 422,
    core.NotFoundError: 404,
    core.OutputExistsError: 409,
    core.OutputNotWritableError: 500,
    core.PhotoRawError: 422,
    core.PhotoTooLargeError: 422,
    core.PhotoUnreadableError: 422,
    core.PhotosNotConnectedError: 422,
    core.RegistrationError: 422,
    core.ResultInsufficientError: 422,
    core.SettingsError: 422,
    core.StageFailedError: 500,
    core.StorageFullError: 507,
    core.TooFewPhotosError: 422,
    core.UnknownDictionaryError: 422,
    core.WrongDictionaryError: 422,
    infra.ArchiveMissingError: 409,
    infra.FhirServerMissingError: 409,
    infra.BackupInvalidError: 422,
    infra.DatabaseDamagedError: 500,
    infra.DatabaseTooNewError: 503,
    infra.DatabaseUnavailableError: 503,
    infra.JobConflictError: 409,
    infra.LegalHoldError: 409,
    infra.LostLeaseError: 409,
    infra.OrderSourceMissingError: 409,
    infra.OrderSourceUnavailableError: 503,
    infra.RestoreTargetError: 409,
    infra.StageTimeoutError: 500,
    infra.StorageUnavailableError: 503,
    infra.StudyKeysMissingError: 503,
    infra.StudyMissingError: 409,
    infra.StudySealedError: 500,
    infra.SyslogUnavailableError: 503,
    infra.WorkerCrashedError: 500,
    service.CamerasMissingError: 404,
    service.ChecksumInvalidError: 400,
    service.ChecksumMismatchError: 460,
    service.CrossSiteRequestError: 403,
    service.ForbiddenError: 403,
    service.IdempotencyConflictError: 409,
    service.IdentityUnavailableError: 503,
    service.MediaTypeError: 415,
    service.MethodNotAllowedError: 405,
    service.NotAcceptableError: 406,
    service.OverloadedError: 503,
    service.PayloadTooLargeError: 413,
    service.PreconditionFailedError: 412,
    service.QuotaExceededError: 413,
    service.RangeNotSatisfiableError: 416,
    service.RateLimitedError: 429,
    service.RequestInvalidError: 422,
    service.RequestTimeoutError: 408,
    service.SignInRefusedError: 403,
    service.SignInUnknownError: 404,
    service.TokenExpiredError: 401,
    service.TokenInvalidError: 401,
    service.TooManyAtOnceError: 429,
    service.TooManyConnectionsError: 503,
    service.UnauthorizedError: 401,
    service.UploadConflictError: 409,
    service.UploadGoneError: 410,
    service.UploadIncompleteError: 409,
    service.UploadLockedError: 423,
}

_CLASSES: dict[int, type[SpecimapError]] = {
    404: core.NotFoundError,
    405: service.MethodNotAllowedError,
    409: service.UploadConflictError,
    413: service.PayloadTooLargeError,
}
"""The other way round, for statuses that the web framework and the tus library answer with themselves."""


def status_of(error: SpecimapError) -> int:
    """Return the HTTP status of an error: its own, or that of the nearest class above it."""
    return next(HTTP_STATUS[leaf] for leaf in type(error).__mro__ if leaf in HTTP_STATUS)


def error_class(status: int) -> type[SpecimapError]:
    """Return the error class for a status that the web framework or the tus library answered with."""
    return _CLASSES.get(status, SpecimapError if status >= 500 else service.RequestInvalidError)
