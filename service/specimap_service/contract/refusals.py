"""How each operation may refuse: the statuses and codes of its errors, by rules and by one table."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from typing import Any

from specimap_core import errors as core
from specimap_core.errors import SpecimapError
from specimap_infra import errors as infra
from specimap_service import errors as service
from specimap_service.http_status import status_of
from specimap_service.problems import MEDIA_TYPE

RETRY_LATER = (service.RateLimitedError, service.OverloadedError, service.TooManyConnectionsError)
"""Errors whose answers have the header Retry-After, and all under them."""
Refusal = type[SpecimapError] | tuple[int, type[SpecimapError]]
"""An error, with its status where it is another than the error's own."""

_RANGES = (service.PreconditionFailedError, service.RangeNotSatisfiableError, infra.StorageUnavailableError)
_TURNS = (service.TooManyAtOnceError, service.OverloadedError)
_CLOUD = (core.CloudDamagedError, infra.StorageUnavailableError)
_ARRAYS = (*_CLOUD, service.NotAcceptableError)
_PICTURE = (*_CLOUD, *_TURNS, core.BackendUnavailableError)
_IN_TAKEN = (
    *_TURNS,
    core.BackendUnavailableError,
    core.StorageFullError,
    infra.JobConflictError,
    infra.StorageUnavailableError,
    service.QuotaExceededError,
)
# Whatever asks for an upload whose last byte has arrived finishes it first.
_TUS: tuple[Refusal, ...] = (
    *_IN_TAKEN,
    (412, service.RequestInvalidError),
    service.UploadGoneError,
    service.UploadLockedError,
)

OWN: dict[str, tuple[Refusal, ...]] = {
    "acquisitions.create": (core.NotFoundError,),
    "acquisitions.delete": (infra.JobConflictError, infra.LegalHoldError, infra.StorageUnavailableError),
    "acquisitions.get_viewpoints": _TURNS,
    "clouds.get": _CLOUD,
    "clouds.get_cameras": (*_RANGES, service.CamerasMissingError),
    "clouds.get_corners": _RANGES,
    "deliveries.create": (core.SettingsError, infra.JobConflictError),
    "dicom.get_archive": (
        *_CLOUD,
        *_TURNS,
        core.BackendFailedError,
        core.MemoryExhaustedError,
        core.OutputNotWritableError,
        core.StageFailedError,
        core.StorageFullError,
        infra.StageTimeoutError,
        infra.StudyKeysMissingError,
        infra.StudyMissingError,
        infra.StudySealedError,
        infra.WorkerCrashedError,
    ),
    "dicom.list": _CLOUD,
    "fhir.get": _CLOUD,
    "fhir.create": (*_CLOUD, infra.FhirServerMissingError, infra.StudyKeysMissingError, infra.StudyMissingError),
    "dicomweb.create": (
        *_TURNS,
        core.BackendUnavailableError,
        core.NotFoundError,
        core.StorageFullError,
        infra.StorageUnavailableError,
        service.MediaTypeError,
    ),
    "dicom.create": (*_CLOUD, infra.ArchiveMissingError, infra.StudyKeysMissingError, infra.StudyMissingError),
    "erasures.create": (
        core.NotFoundError,
        core.OutputNotWritableError,
        core.SettingsError,
        core.StorageFullError,
        infra.JobConflictError,
        infra.LegalHoldError,
        infra.StorageUnavailableError,
    ),
    "exports.create": (*_CLOUD, core.SettingsError),
    "exports.get": _CLOUD,
    "exports.get_content": (*_RANGES, infra.JobConflictError, core.SettingsError),
    "exports.head_content": (*_RANGES, infra.JobConflictError, core.SettingsError),
    "exports.list": _CLOUD,
    "files.create": (*_IN_TAKEN, service.ChecksumMismatchError),
    "files.delete": (infra.JobConflictError, infra.LegalHoldError, infra.StorageUnavailableError),
    "files.get_content": _RANGES,
    "health.get_readiness": (infra.StorageUnavailableError,),
    "jobs.cancel": (infra.JobConflictError,),
    "jobs.create": (
        core.NotFoundError,
        core.SettingsError,
        service.UploadIncompleteError,
    ),
    "jobs.delete": (infra.JobConflictError, infra.LegalHoldError, infra.StorageUnavailableError),
    "jobs.get_report": (infra.JobConflictError,),
    "jobs.rerun": (core.SettingsError, service.UploadIncompleteError),
    "keys.create": (core.NotFoundError,),
    "labels.delete": (service.PreconditionFailedError, infra.LegalHoldError, infra.StorageUnavailableError),
    "labels.get_values": _ARRAYS,
    "labels.put": (
        *_CLOUD,
        core.LabelInvalidError,
        core.StorageFullError,
        service.MediaTypeError,
        service.PreconditionFailedError,
        service.QuotaExceededError,
    ),
    "orders.select": (*_TURNS, core.SettingsError, infra.OrderSourceMissingError, infra.OrderSourceUnavailableError),
    **{f"previews.get_{name}": _PICTURE for name in ("rgb", "pca", "band", "composite", "index", "label")},
    "projects.create": (core.SettingsError, infra.JobConflictError),
    "projects.update": (core.SettingsError, infra.JobConflictError),
    "sessions.create": (service.UnauthorizedError, service.CrossSiteRequestError, service.RateLimitedError),
    "shares.create": (service.QuotaExceededError,),
    "spectra.get_band": (*_ARRAYS, *_TURNS),
    "spectra.get_point": _CLOUD,
    "spectra.select": (*_ARRAYS, *_TURNS),
    "studies.get": (infra.StudyKeysMissingError, infra.StudySealedError),
    "studies.delete": (infra.LegalHoldError,),
    "studies.put": (infra.LegalHoldError, infra.StudyKeysMissingError, infra.StudySealedError),
    "sso.get_start": (service.SignInUnknownError, service.CrossSiteRequestError, service.RateLimitedError),
    "sso.get_callback": (service.SignInUnknownError, service.RateLimitedError),
    "uploads.create": (
        (412, service.RequestInvalidError),
        core.NotFoundError,
        core.StorageFullError,
        infra.JobConflictError,
        infra.StorageUnavailableError,
        service.QuotaExceededError,
    ),
    "uploads.get_offset": _TUS,
    "uploads.append": (
        *_TUS,
        (400, service.RequestInvalidError),
        (415, service.RequestInvalidError),
        service.ChecksumInvalidError,
        service.ChecksumMismatchError,
        service.UploadConflictError,
    ),
    "uploads.delete": _TUS,
    "uploads.get_result": _IN_TAKEN,
    "zarr.get": (*_RANGES, core.CloudDamagedError),
    "zarr.head": (*_RANGES, core.CloudDamagedError),
}
"""Errors of single operations, by operation id, beside those that :func:`common` finds."""


def common(method: str, path: str, operation: dict[str, Any]) -> Iterable[Refusal]:
    """Find the errors that an operation shares with all that are like it."""
    yield service.TooManyConnectionsError
    if method not in ("get", "head", "options"):
        yield service.PayloadTooLargeError
        yield service.RequestTimeoutError
    # Even without parameters: those in a query that it does not know are refused.
    yield service.RequestInvalidError
    if operation.get("security"):
        yield from (service.UnauthorizedError, service.TokenInvalidError, service.TokenExpiredError)
        yield from (service.ForbiddenError, service.RateLimitedError, service.IdentityUnavailableError)
        # A browser may say of any request that another site's page made it.
        yield service.CrossSiteRequestError
    if path != "/healthz":
        yield infra.DatabaseUnavailableError
    if "{" in path:
        yield core.NotFoundError
    if any(parameter["name"] == "idempotency-key" for parameter in operation.get("parameters", ())):
        # What the request made before may have been deleted since.
        yield from (service.IdempotencyConflictError, core.NotFoundError)


class Refusals:
    """Answers to errors, each kind of answer once among the document's components."""

    def __init__(self, contract: dict[str, Any]) -> None:
        self._known: dict[str, Any] = contract["components"].setdefault("responses", {})
        self._ranges = {name: {"$ref": f"#/components/responses/{title}"} for name, title in _OTHERS.items()}
        for title in _OTHERS.values():
            self._known[title] = {"description": f"{title} for another reason", "content": _content()}

    def add(self, method: str, path: str, operation: dict[str, Any]) -> None:
        """Add to an operation the answers to all its errors."""
        found: dict[int, set[type[SpecimapError]]] = {}
        for refusal in (*common(method, path, operation), *OWN.get(operation["operationId"], ())):
            status, error = refusal if isinstance(refusal, tuple) else (_status(refusal), refusal)
            found.setdefault(status, set()).add(error)
        answers = operation["responses"]
        answers |= {str(status): self._of(status, found[status]) for status in sorted(found)}
        # Last, since they stand for what no other names.
        operation["responses"] = {status: answers[status] for status in answers if status not in self._ranges}
        operation["responses"] |= self._ranges

    def _of(self, status: int, errors: set[type[SpecimapError]]) -> dict[str, str]:
        leaves = sorted(errors, key=lambda error: error.code)
        title = "Or".join(leaf.__name__.removesuffix("Error") for leaf in leaves)
        if any(_status(leaf) != status for leaf in leaves):
            title += str(status)
        if title not in self._known:
            self._known[title] = _answer(status, leaves)
        return {"$ref": f"#/components/responses/{title}"}


_OTHERS = {"4XX": "Refused", "5XX": "Failed"}


def _status(error: type[SpecimapError]) -> int:
    return status_of(error("", advice=""))


def _answer(status: int, errors: list[type[SpecimapError]]) -> dict[str, Any]:
    examples = {error.code: {"value": _example(status, error)} for error in errors}
    answer: dict[str, Any] = {
        "description": "\n".join(f"`{error.code}`: {_meaning(error)}" for error in errors),
        "content": _content(examples),
        "x-codes": [error.code for error in errors],
    }
    late = [error.code for error in errors if issubclass(error, RETRY_LATER)]
    if late:
        which = "" if len(late) == len(errors) else f" With {' and '.join(f'`{code}`' for code in late)}."
        answer["headers"] = {
            "Retry-After": {"description": f"Seconds to wait.{which}", "schema": {"type": "integer", "minimum": 0}}
        }
    return answer


def _meaning(error: type[SpecimapError]) -> str:
    return " ".join(inspect.cleandoc(error.__doc__ or "").split("\n\n")[0].split()).replace("``", "`")


def _example(status: int, error: type[SpecimapError]) -> dict[str, Any]:
    return {
        "type": f"urn:specimap:error:{error.code}",
        "title": error.code,
        "status": status,
        "code": error.code,
        "detail": _meaning(error),
        "advice": "What to do, for the request that was made.",
        "details": {"retry_after_s": 2} if issubclass(error, RETRY_LATER) else {},
        "correlation_id": "5f0c2a9d8b7e4c31",
    }


def _content(examples: dict[str, Any] | None = None) -> dict[str, Any]:
    schema = {"$ref": "#/components/schemas/Problem"}
    return {MEDIA_TYPE: {"schema": schema, **({"examples": examples} if examples else {})}}
