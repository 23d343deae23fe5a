"""Authentication of requests: the key, the session or the token, its rate limit, its permissions."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Annotated

import structlog
from fastapi import Depends, FastAPI, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer

from specimap_infra.errors import DatabaseUnavailableError
from specimap_service.app_state import AppState
from specimap_service.audit_note import NOTE
from specimap_service.auth.access import Access
from specimap_service.auth.credentials import COOKIE, PAGE_HEADER, Credential, credential_of
from specimap_service.auth.keys import KEPT_SECONDS, Keyring, Principal
from specimap_service.auth.permissions import OPERATIONS, roles_for, scope_for
from specimap_service.auth.rate_limit import Left, RateLimiter
from specimap_service.context import ANSWER_HEADERS, AppContext
from specimap_service.errors import ForbiddenError, IdentityUnavailableError, RateLimitedError, UnauthorizedError
from specimap_service.feature import Feature

if TYPE_CHECKING:
    from specimap_service.auth.oidc.identity import Identity

SESSION = "/v1/session"
NOT_SHARED = ("shares", "dicom", "dicom.zip", "fhir")
"""Parts of a result that its shares do not show: who else has a link to it, and what the hospital has of it."""
FAILURES_PER_MINUTE = 60
"""Wrong keys that one address may present a minute before it has to wait."""
KEYRING = AppState[Keyring]("keyring")
LIMITER = AppState[RateLimiter]("limiter")
ACCESS = AppState[Access]("access")
IDENTITY: AppState[Identity | None] = AppState("identity")
"""None where the service has no identity provider."""


def _open(app: FastAPI, context: AppContext) -> None:
    settings = context.settings
    identity = None
    if settings.oidc_issuer:
        # Imported late: without a provider, nothing of its protocol is loaded.
        from specimap_service.auth.oidc.identity import Identity

        identity = Identity(settings, context.database)
    IDENTITY.set(app, identity)
    KEYRING.set(app, Keyring(context.database, settings.rate_per_minute, settings.quota_bytes, identity))
    LIMITER.set(app, RateLimiter())
    ACCESS.set(app, Access(context.database))


@asynccontextmanager
async def _running(app: FastAPI) -> AsyncIterator[None]:
    try:
        yield
    finally:
        identity = IDENTITY.of(app)
        if identity is not None:
            identity.close()


FEATURE = Feature(_open, _running)
KeyringDep = Annotated[Keyring, Depends(KEYRING.of_request)]
AccessDep = Annotated[Access, Depends(ACCESS.of_request)]
PRINCIPAL = "specimap.principal"
"""Key under which a request's ASGI scope holds its principal, once that is known."""


async def authenticated(request: Request) -> Principal:
    """Return the principal of a request by its headers alone, and count it against the key's rate.

    Raises:
        UnauthorizedError: there is no key, or no valid one. RateLimitedError: too many requests, or wrong keys.
        CrossSiteRequestError: it has a session's cookie, and may come from the page of another site.
        ForbiddenError: it comes by a share's link, and asks for anything but the share's cloud.
        DatabaseUnavailableError: keys cannot be looked up. IdentityUnavailableError: nor can the provider's.
    """
    found = await known_by(request, credential_of(request))
    check_shared(found, request.method, request.scope["path"])
    return found


def check_shared(principal: Principal, method: str, path: str) -> None:
    """Check that a share is used to read its own cloud; who else has a link to it is no part of that.

    Raises:
        ForbiddenError: it asks for anything else, whether that exists or not.
    """
    if principal.cloud_id is None or path == SESSION:
        return
    cloud = f"/v1/clouds/{principal.cloud_id}"
    own = path == cloud or path.startswith(f"{cloud}/")
    reads = method in ("GET", "HEAD") or (method, path) == ("POST", f"{cloud}/spectra")
    if not (own and reads) or path.removeprefix(f"{cloud}/").partition("/")[0] in NOT_SHARED:
        raise ForbiddenError(
            "The link shows one result and nothing else.",
            advice="Sign in with a key for more.",
            cloud_id=principal.cloud_id,
        )


async def known_by(request: Request, credential: Credential) -> Principal:
    """Return the principal of a credential that a request presents; counts and raises as :func:`authenticated`."""
    keyring, limiter = KEYRING.of(request.app), LIMITER.of(request.app)
    try:
        found = keyring.trusted(credential)
        if found is None:
            # A thread costs as much as the rest of a short request, so it is taken only to ask the database.
            found = await run_in_threadpool(keyring.principal, credential)
    except UnauthorizedError:
        address = request.client.host if request.client else "unknown"
        limiter.take(f"address:{address}", FAILURES_PER_MINUTE)
        raise
    if (note := NOTE.get()) is not None:
        note.actor, note.session_id = found.key_id, found.session_id or ""
        # Of several projects, an entry names that of its target.
        note.project_id = found.project_ids[0] if len(found.project_ids) == 1 else ""
    try:
        left = limiter.take(found.key_id, found.rate_per_minute)
    except RateLimitedError as error:
        left = Left(found.rate_per_minute, 0, int(str(error.details["retry_after_s"])))
        raise
    finally:
        request.scope.get(ANSWER_HEADERS, {}).update(left.headers())
    structlog.contextvars.bind_contextvars(key=found.key_id)
    return found


def trust_of(request: Request) -> Callable[[], Awaitable[float | None]]:
    """Make a check for answers that last: the seconds for which the request's key or session is trusted, None where it
    no longer is. One that cannot be looked up keeps its trust."""
    keyring, credential = KEYRING.of(request.app), credential_of(request)

    async def seconds() -> float | None:
        left = keyring.trusted_seconds(credential)
        if left > 0:
            return left
        try:
            await run_in_threadpool(keyring.principal, credential)
        except UnauthorizedError:
            return None
        except (DatabaseUnavailableError, IdentityUnavailableError):
            return KEPT_SECONDS
        return keyring.trusted_seconds(credential)

    return seconds


_bearer = HTTPBearer(
    auto_error=False,
    scheme_name="key",
    description="`Authorization: Bearer` with a key, `spk_…`, or with an access token of the identity provider.",
)
_cookie = APIKeyCookie(
    name=COOKIE,
    auto_error=False,
    scheme_name="session",
    description="The cookie of a session, which `POST /v1/session` sets, or a sign-in with the identity provider, "
    "for the service's own pages. It counts where there is no key. Requests that change something have the header "
    f"`{PAGE_HEADER}: 1` with it.",
)


async def known_principal(
    request: Request,
    _: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
    __: Annotated[str | None, Depends(_cookie)],
) -> Principal:
    """Return the request's principal: a dependency. What others need of it counts as one request."""
    # Already known where the request may have a body, which is not read before.
    found: Principal = request.scope.get(PRINCIPAL) or await authenticated(request)
    return found


Known = Annotated[Principal, Depends(known_principal)]


def permission_of(operation: str) -> str | None:
    """Return the permission that an operation asks for; None where every key, person and share will do.

    Raises:
        LookupError: the table does not say.
    """
    if operation not in OPERATIONS:
        raise LookupError(f"service/specimap_service/auth/permissions.py does not say who may {operation}")
    return OPERATIONS[operation]


async def permitted(request: Request, found: Known) -> Principal:
    """Return the request's principal, if it has the permission of the operation: a dependency.

    Raises:
        ForbiddenError: it has not; details name the scope that the key lacks, or the permission of no role.
    """
    permission = permission_of(request.scope["route"].operation_id)
    if permission is not None:
        check_permission(found, permission)
    return found


def check_permission(principal: Principal, permission: str) -> None:
    """Raise ForbiddenError unless a principal has a permission."""
    if principal.may(permission):
        return
    if principal.is_person:
        roles = " or ".join(roles_for(permission))
        raise ForbiddenError(
            f"Your role does not permit this: {permission}.",
            advice=f"It takes the role {roles}; ask whoever manages the accounts.",
            permission=permission,
        )
    scope = scope_for(permission)
    raise ForbiddenError(f"The key lacks the scope {scope!r}.", advice="Use a key that has it.", scope=scope)


Permitted = Annotated[Principal, Depends(permitted)]
"""The principal of a request that the table of permissions permits."""
# Other names of it, which say what a route does; what it takes stands in the table alone.
