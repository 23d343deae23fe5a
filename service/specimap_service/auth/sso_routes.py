"""Signing in and out on the service's own pages with the account of an identity provider."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import RedirectResponse
from pydantic import BaseModel, Field

from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import Person
from specimap_service.auth.credentials import COOKIE, check_page
from specimap_service.auth.dependencies import IDENTITY, LIMITER, KeyringDep, Known
from specimap_service.auth.session_routes import end_audited, end_of_token, over_tls, set_cookie
from specimap_service.auth.sessions import new_session, session_id
from specimap_service.context import AppContext, Context, audit
from specimap_service.errors import IdentityUnavailableError, SignInRefusedError, SignInUnknownError

if TYPE_CHECKING:
    from specimap_service.auth.oidc.identity import Identity
    from specimap_service.auth.oidc.sign_in import Finished

router = APIRouter(prefix="/v1/sso", tags=["sso"])
SIGN_INS_PER_MINUTE = 240
"""Begun and ended from one address, which may be a proxy's."""
ATTEMPT_COOKIE = "specimap_sign_in"
"""Of the browser that began a sign-in: no other may end it."""
HINT_COOKIE = "specimap_id_token"
"""The ID token, for the sign-out at the provider: it tells of a person, so the browser keeps it, not the service."""
LARGEST_HINT = 3500
"""Browsers keep no cookie above 4096 bytes; without it the provider asks whether to sign out."""
Text = Annotated[str | None, Query(max_length=4096)]


class SsoOptions(BaseModel):
    """Whether people can sign in with the account of an identity provider."""

    enabled: bool
    name: str = Field(description="Name of the account for the sign-in page; empty where the page's own words will do.")


class SignedOut(BaseModel):
    """A session that has ended."""

    end_session_url: str | None = Field(
        description="Where the browser goes next, to sign out at the identity provider too; null where that offers no "
        "such thing, or the session was no person's."
    )


@router.get("", operation_id="sso.get")
def get_sso(context: Context) -> SsoOptions:
    """Tell whether people can sign in with the account of an identity provider."""
    settings = context.settings
    return SsoOptions(enabled=bool(settings.oidc_issuer), name=settings.oidc_name)


@router.get("/login", status_code=303, response_class=Response, operation_id="sso.get_start")
def begin_sign_in(
    context: Context,
    request: Request,
    return_to: Annotated[
        str, Query(max_length=1500, description="What the page's address has after `#`; anything else is left out.")
    ] = "",
) -> Response:
    """Send a browser to the identity provider, for pages of the service itself. It comes back to `/v1/sso/callback`."""
    from specimap_service.auth.oidc.sign_in import ATTEMPT_MINUTES, begin

    identity = _identity(request)
    check_page(request)
    _count(request)
    token = request.cookies.get(COOKIE)
    try:
        address, browser = begin(identity, context.database, return_to, token and session_id(token))
    except IdentityUnavailableError as error:
        return _to_page(identity, f"#/?sso={error.code}")
    answer = _redirect(address)
    _set(answer, request, context.settings, ATTEMPT_COOKIE, browser, 60 * ATTEMPT_MINUTES, strict=False)
    return answer


@router.get("/callback", status_code=303, response_class=Response, operation_id="sso.get_callback")
def finish_sign_in(
    context: Context,
    request: Request,
    keyring: KeyringDep,
    state: Text = None,
    code: Text = None,
    iss: Text = None,
    error: Text = None,
) -> Response:
    """End a sign-in: the identity provider sends the browser here. Parameters that it adds beyond these do not count.

    The answer sends the browser to the pages, with a session or with the reason why there is none, and never elsewhere.
    """
    from specimap_service.auth.oidc.sign_in import finish

    identity = _identity(request)
    _count(request)
    given = {"state": state, "code": code, "iss": iss, "error": error}
    browser = request.cookies.get(_name(request, context.settings, ATTEMPT_COOKIE))
    try:
        finished = finish(identity, context.database, {k: v for k, v in given.items() if v is not None}, browser)
        token, seconds = _begin_session(context, identity, finished)
    except (SignInRefusedError, IdentityUnavailableError) as refusal:
        reason = str(refusal.details.get("reason", refusal.code))
        logger().warning("sign-in refused", reason=reason, told=refusal.message)
        answer = _to_page(identity, f"#/?sso={reason}")
    else:
        keyring.forget()
        answer = _to_page(identity, f"#{finished.return_to or '/'}")
        set_cookie(answer, request, context.settings, token, seconds)
        hint = finished.id_token if len(finished.id_token) <= LARGEST_HINT else ""
        _set(answer, request, context.settings, HINT_COOKIE, hint, seconds if hint else 0)
    _set(answer, request, context.settings, ATTEMPT_COOKIE, "", 0, strict=False)
    return answer


@router.post("/logout", operation_id="sso.end")
def sign_out(
    context: Context, principal: Known, keyring: KeyringDep, request: Request, response: Response
) -> SignedOut:
    """Sign out: the session ends, and the answer says where the browser signs out at the identity provider too."""
    identity, hint = IDENTITY.of(request.app), request.cookies.get(_name(request, context.settings, HINT_COOKIE))
    end_of_token(context, request.cookies.get(COOKIE))
    keyring.forget()
    set_cookie(response, request, context.settings, "", 0)
    _set(response, request, context.settings, HINT_COOKIE, "", 0)
    address = None
    if identity is not None and principal.is_person and principal.session_id is not None:
        try:
            address = identity.end_address(hint)
        except IdentityUnavailableError:
            # The session here has ended; the provider's ends by itself.
            address = None
    return SignedOut(end_session_url=address)


def _begin_session(context: AppContext, identity: Identity, finished: Finished) -> tuple[str, int]:
    """Begin the session of a person who signed in; return its token, and how many seconds it lasts."""
    from specimap_service.auth.oidc.sign_in import refused

    hours = context.settings.session_hours
    with context.database.session() as session:
        granted = identity.granted(session, finished.claims)
        person = session.get_one(Person, granted.person_id)
        ask = "Ask whoever manages the accounts."
        if person.blocked_at is not None:
            raise refused("blocked", "The account is blocked in Specimap.", ask)
        if not granted.roles:
            raise refused("no_role", "The account has no role in Specimap.", ask)
        if finished.session_before is not None:
            end_audited(session, finished.session_before)
        _, token = new_session(session, person, hours, granted=granted.stored())
        audit(session, person.id, "session.create", person.id, roles=list(granted.roles))
    return token, int(hours * 3600)


def _identity(request: Request) -> Identity:
    found = IDENTITY.of(request.app)
    if found is None:
        raise SignInUnknownError(
            "People cannot sign in with an identity provider here.",
            advice="Sign in with a key; docs/identity.md says how to set up a provider.",
        )
    return found


def _count(request: Request) -> None:
    address = request.client.host if request.client else "unknown"
    LIMITER.of(request.app).take(f"sign-in:{address}", SIGN_INS_PER_MINUTE)


def _redirect(address: str) -> Response:
    return RedirectResponse(address, 303, {"Cache-Control": "no-store", "Referrer-Policy": "no-referrer"})


def _to_page(identity: Identity, fragment: str) -> Response:
    return _redirect(identity.page_address(fragment))


def _name(request: Request, settings: ServiceSettings, name: str) -> str:
    # With this prefix a browser takes the cookie from no other host of the same domain.
    return f"__Host-{name}" if over_tls(request, settings) else name


def _set(
    answer: Response,
    request: Request,
    settings: ServiceSettings,
    name: str,
    value: str,
    seconds: int,
    *,
    strict: bool = True,
) -> None:
    answer.set_cookie(
        _name(request, settings, name),
        value,
        max_age=seconds,
        path="/",
        secure=over_tls(request, settings),
        httponly=True,
        # The way back from the provider begins at another site.
        samesite="strict" if strict else "lax",
    )
