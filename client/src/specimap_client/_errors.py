# ruff: noqa: N818 - named as httpx names them: what happened, without the word Error.
"""All that the client raises on purpose.

::

    SpecimapClientError
    ├── ApiError                    the service answered with an error: code, message, advice, details, status
    │   ├── Refused                 4xx: the request must change
    │   │   ├── Unauthorized        401: no key, or one that is unknown, expired or revoked
    │   │   ├── Forbidden           403: the key lacks the scope
    │   │   ├── NotFound            404
    │   │   ├── Conflict            409, 412: the state, version or idempotency key does not allow it
    │   │   └── RateLimited         429: retry_after says when to come back
    │   └── ServerError             5xx, after the retries
    ├── ConnectionFailed            the service cannot be reached, or the connection broke, after the retries
    ├── Timeout                     no answer, or no result, in the time given
    ├── UnexpectedAnswer            the answer is not of the contract: another program, or a proxy, answers there
    ├── UploadFailed                a file did not arrive; files holds those that did
    ├── JobFailed                   the job ended without a result; job says why
    ├── ExportFailed                the export ended without a file
    ├── NotConfigured               there is no address or key, or one that cannot be
    └── MissingExtra                an optional package is not installed

``Timeout``, ``ConnectionFailed``, ``NotConfigured`` and ``MissingExtra`` also are the builtins ``TimeoutError``,
``ConnectionError``, ``ValueError`` and ``ImportError``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from specimap_client._models import Export, File, Job


class SpecimapClientError(Exception):
    """Root of all errors of the client."""


class ApiError(SpecimapClientError):
    """The service answered with an error.

    ``code`` is stable (docs/errors.md), ``details`` hold values for programs, and the log of the service has
    ``correlation_id`` in the lines of the same request.
    """

    def __init__(
        self,
        code: str,
        message: str,
        advice: str = "",
        details: Mapping[str, Any] | None = None,
        status: int = 0,
        correlation_id: str = "",
    ) -> None:
        super().__init__(code, message, advice, details, status, correlation_id)
        self.code = code
        self.message = message
        self.advice = advice
        self.details: dict[str, Any] = dict(details or {})
        self.status = status
        self.correlation_id = correlation_id

    def __str__(self) -> str:
        text = f"{self.message} {self.advice}".strip()
        return f"{text} [{self.code}, {self.status}, correlation id {self.correlation_id or 'unknown'}]"


class Refused(ApiError):
    """4xx: repeating the same request does not help."""


class Unauthorized(Refused):
    """No key, or one that is unknown, expired or revoked."""


class Forbidden(Refused):
    """The key lacks the scope; ``details['scope']`` names it."""


class NotFound(Refused):
    """There is no such thing, or no longer."""


class Conflict(Refused):
    """The state, the version or the idempotency key does not allow what was asked."""


class RateLimited(Refused):
    """More requests than the key may make; ``retry_after`` is the seconds to wait, None where it was not told."""

    retry_after: float | None = None


class ServerError(ApiError):
    """The service failed; requests that are safe to repeat were repeated."""


class ConnectionFailed(SpecimapClientError, ConnectionError):
    """The service cannot be reached, or the connection broke."""


class Timeout(SpecimapClientError, TimeoutError):
    """No answer, or no result, in the time given."""


class UnexpectedAnswer(SpecimapClientError):
    """The answer is not of the contract: another program, or a proxy, answers at the address."""


class UploadFailed(SpecimapClientError):
    """A file did not arrive.

    ``path`` is the file, ``code`` says why, ``files`` are those of the same call that did arrive, and ``upload_id``
    the upload that may be gone on with, where one was begun.
    """

    def __init__(
        self, message: str, *, path: str, code: str = "upload_failed", advice: str = "", upload_id: str | None = None
    ) -> None:
        super().__init__(f"{message} {advice}".strip())
        self.path = path
        self.code = code
        self.advice = advice
        self.upload_id = upload_id
        self.files: Sequence[File] = ()


class JobFailed(SpecimapClientError):
    """The job failed or was cancelled; ``job.error`` has code, message, advice and details."""

    def __init__(self, job: Job) -> None:
        error = job.error
        why = f"{error.message} {error.advice}".strip() if error else f"It was {job.state}."
        super().__init__(f"{job.id} ended without a result. {why}")
        self.job = job
        self.code = error.code if error else job.state


class ExportFailed(SpecimapClientError):
    """The export ended without a file."""

    def __init__(self, export: Export) -> None:
        why = f"{export.error.message} {export.error.advice}".strip() if export.error else f"It was {export.state}."
        super().__init__(f"The export {export.format} of {export.cloud_id} ended without a file. {why}")
        self.export = export


class NotConfigured(SpecimapClientError, ValueError):
    """There is no address or key, or one that cannot be."""


class MissingExtra(SpecimapClientError, ImportError):
    """An optional package is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"This needs {package}. Install it: pip install 'specimap-client[{extra}]'")


_LEAVES: dict[int, type[ApiError]] = {
    401: Unauthorized,
    403: Forbidden,
    404: NotFound,
    409: Conflict,
    412: Conflict,
    429: RateLimited,
}


def leaf_of(status: int) -> type[ApiError]:
    """The class for an HTTP status of 400 or more."""
    return _LEAVES.get(status, ServerError if status >= 500 else Refused)
