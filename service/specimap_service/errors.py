"""Errors that only a request can cause."""

from __future__ import annotations

from specimap_core.errors import SpecimapError


class UnauthorizedError(SpecimapError, PermissionError):
    """No key, or one that is unknown, expired or revoked; or a session that has ended."""

    code = "unauthorized"


class TokenInvalidError(UnauthorizedError):
    """The access token is not one that counts here; ``details['reason']`` says what is wrong with it."""

    code = "token_invalid"


class TokenExpiredError(UnauthorizedError):
    """The access token has expired; the identity provider gives a new one."""

    code = "token_expired"


class IdentityUnavailableError(SpecimapError, ConnectionError):
    """The identity provider does not answer, or not as it should: nobody signs in with it, and keys go on working."""

    code = "identity_unavailable"


class SignInRefusedError(SpecimapError, PermissionError):
    """A sign-in with the identity provider did not succeed; ``details['reason']`` says why."""

    code = "sign_in_refused"


class SignInUnknownError(SpecimapError, LookupError):
    """The service has no identity provider."""

    code = "sign_in_not_configured"


class ForbiddenError(SpecimapError, PermissionError):
    """The key is valid but lacks the scope, which ``details['scope']`` names; a person's roles lack the permission in
    ``details['permission']``; or a share shows another result."""

    code = "forbidden"


class CrossSiteRequestError(SpecimapError, PermissionError):
    """A request with a session's cookie that may come from the page of another site."""

    code = "cross_site_request"


class RateLimitedError(SpecimapError, RuntimeError):
    """More requests than the key may make; try again after ``details['retry_after_s']`` seconds."""

    code = "rate_limited"


class TooManyAtOnceError(RateLimitedError):
    """The key has too many requests of a costly kind waiting; try again after ``details['retry_after_s']`` seconds."""

    code = "too_many_at_once"


class OverloadedError(SpecimapError, RuntimeError):
    """All keys together ask for more than the service can do; try again after ``details['retry_after_s']`` seconds."""

    code = "overloaded"


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
    """A job was requested before all its files had arrived; details list what is missing."""

    code = "upload_incomplete"


class UploadConflictError(SpecimapError, ValueError):
    """The upload's offset, length or checksum differs from what the client sent."""

    code = "upload_conflict"


class ChecksumMismatchError(SpecimapError, ValueError):
    """The bytes that arrived do not have the checksum sent with them; none of them was kept."""

    code = "checksum_mismatch"


class UploadLockedError(SpecimapError, RuntimeError):
    """Another request is writing to the same upload."""

    code = "upload_locked"


class UploadGoneError(SpecimapError, FileNotFoundError):
    """The upload expired or was terminated; ``details['state']`` says which."""

    code = "upload_gone"


class IdempotencyConflictError(SpecimapError, ValueError):
    """The idempotency key was used before, with another request."""

    code = "idempotency_conflict"


class PreconditionFailedError(SpecimapError, ValueError):
    """The stored version is not the one that the request's If-Match names."""

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


class ChecksumInvalidError(SpecimapError, ValueError):
    """Upload-Checksum names an algorithm that is not served, or its digest does not read."""

    code = "checksum_invalid"


class RequestTimeoutError(SpecimapError, TimeoutError):
    """The rest of a request did not arrive in time; ``details['seconds']`` says how long the service waits."""

    code = "request_timeout"


class CamerasMissingError(SpecimapError, FileNotFoundError):
    """The result comes from a version that kept no cameras."""

    code = "cameras_missing"


class TooManyConnectionsError(SpecimapError, RuntimeError):
    """The service has as many connections as it takes; try again after ``details['retry_after_s']`` seconds."""

    code = "too_many_connections"
