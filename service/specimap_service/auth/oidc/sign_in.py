"""The sign-in on the pages: authorization code flow with PKCE, state and nonce, bound to one browser, once."""

from __future__ import annotations

import datetime
import hmac
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import sqlalchemy as sa
from authlib.oauth2.auth import ClientAuth
from authlib.oauth2.rfc6749.parameters import prepare_grant_uri, prepare_token_request
from authlib.oauth2.rfc7636 import create_s256_code_challenge
from sqlalchemy.orm import Session

from specimap_infra.database import Database, rows_changed, utc_now
from specimap_infra.tables import SignInAttempt
from specimap_service.auth.credentials import secret_hash
from specimap_service.auth.oidc.fetching import ask, unavailable
from specimap_service.auth.oidc.identity import Identity
from specimap_service.auth.oidc.provider import Description
from specimap_service.auth.oidc.tokens import id_claims
from specimap_service.errors import SignInRefusedError, TokenExpiredError, TokenInvalidError

ATTEMPT_MINUTES = 15
MOST_ATTEMPTS = 20_000
"""Sign-ins under way at a time; the oldest make room."""
CALLBACK = "v1/sso/callback"
FORM = {"Content-Type": "application/x-www-form-urlencoded", "Accept": "application/json"}
RETURN = re.compile(r"/[A-Za-z0-9/_.~%?=&,:;!+-]{0,1500}")
"""What may follow ``#`` in the address of a page."""
Reason = Literal[
    "attempt_unknown",
    "other_browser",
    "other_issuer",
    "provider_refused",
    "code_refused",
    "token_invalid",
    "no_role",
    "blocked",
]


@dataclass(frozen=True)
class Finished:
    """A sign-in that succeeded."""

    claims: Mapping[str, Any]
    id_token: str
    return_to: str
    session_before: str | None


def refused(reason: Reason, told: str, advice: str = "Sign in again.") -> SignInRefusedError:
    """Make the error for a sign-in that does not succeed; ``reason`` is a stable word."""
    return SignInRefusedError(told, advice=advice, reason=reason)


def begin(identity: Identity, database: Database, return_to: str, session_before: str | None) -> tuple[str, str]:
    """Begin a sign-in; return the address at the provider, and the token for the browser that alone may end it.

    Raises:
        IdentityUnavailableError: the provider does not answer.
    """
    description = identity.provider.description()
    state, browser, nonce, verifier = (secrets.token_urlsafe(48) for _ in range(4))
    with database.session() as session:
        _make_room(session)
        session.add(
            SignInAttempt(
                id=secret_hash(state),
                browser_hash=secret_hash(browser),
                nonce=nonce,
                code_verifier=verifier,
                return_to=return_to if RETURN.fullmatch(return_to) else "",
                session_before=session_before,
                expires_at=utc_now() + datetime.timedelta(minutes=ATTEMPT_MINUTES),
            )
        )
    address = prepare_grant_uri(
        description.address("authorization_endpoint"),
        client_id=identity.settings.oidc_client_id,
        response_type="code",
        redirect_uri=identity.page_address(CALLBACK),
        scope=identity.settings.oidc_scopes,
        state=state,
        nonce=nonce,
        code_challenge=create_s256_code_challenge(verifier),
        code_challenge_method="S256",
    )
    return address, browser


def finish(identity: Identity, database: Database, answer: Mapping[str, str], browser: str | None) -> Finished:
    """End a sign-in with what the provider sent the browser back with.

    Args:
        browser: the token that :func:`begin` gave the browser.

    Raises:
        SignInRefusedError: it does not succeed; ``details['reason']`` says why.
        IdentityUnavailableError: the provider does not answer.
    """
    attempt = _taken(database, answer.get("state", ""), browser)
    description = identity.provider.description()
    # Only the provider that was asked may answer: another's code would be sent to this one (RFC 9207).
    named = answer.get("iss")
    must = description.values.get("authorization_response_iss_parameter_supported") is True
    if named != identity.provider.issuer and (named is not None or must):
        raise refused("other_issuer", "The answer comes from another identity provider.")
    if "error" in answer or not answer.get("code"):
        raise refused("provider_refused", "The identity provider did not let you in.")
    tokens = _exchanged(identity, description, answer["code"], attempt.code_verifier)
    try:
        claims = id_claims(
            identity.provider,
            tokens["id_token"],
            identity.rules(identity.settings.oidc_client_id),
            nonce=attempt.nonce,
            access_token=tokens.get("access_token"),
        )
    except (TokenInvalidError, TokenExpiredError) as error:
        told = f"The identity provider's answer does not count. {error.message}"
        raise refused(
            "token_invalid", told, "Ask whoever runs the service: its settings or clock may be wrong."
        ) from error
    return Finished(
        _completed(identity, description, claims, tokens.get("access_token")),
        tokens["id_token"],
        attempt.return_to,
        attempt.session_before,
    )


def _make_room(session: Session) -> None:
    session.execute(sa.delete(SignInAttempt).where(SignInAttempt.expires_at < utc_now()))
    oldest = sa.select(SignInAttempt.id).order_by(SignInAttempt.expires_at.desc()).offset(MOST_ATTEMPTS)
    for attempt in session.scalars(oldest).all():
        session.execute(sa.delete(SignInAttempt).where(SignInAttempt.id == attempt))


def _taken(database: Database, state: str, browser: str | None) -> SignInAttempt:
    """Return the attempt of a state, which it ends: an answer counts once, in the browser that asked."""
    with database.session() as session:
        found = session.get(SignInAttempt, secret_hash(state))
        if found is None or found.expires_at < utc_now():
            raise refused("attempt_unknown", "This sign-in has ended, or took too long.")
        if browser is None or not hmac.compare_digest(secret_hash(browser), found.browser_hash):
            raise refused("other_browser", "This sign-in was begun in another browser.")
        session.expunge(found)
        if not rows_changed(session.execute(sa.delete(SignInAttempt).where(SignInAttempt.id == found.id))):
            raise refused("attempt_unknown", "This sign-in has ended, or took too long.")
        return found


def _exchanged(identity: Identity, description: Description, code: str, verifier: str) -> dict[str, Any]:
    """Exchange a code for tokens."""
    settings = identity.settings
    offered = description.says("token_endpoint_auth_methods_supported") or ["client_secret_basic"]
    method = "none"
    if settings.oidc_client_secret.get_secret_value():
        method = "client_secret_basic" if "client_secret_basic" in offered else "client_secret_post"
    body = prepare_token_request(
        "authorization_code",
        code=code,
        redirect_uri=identity.page_address(CALLBACK),
        code_verifier=verifier,
    )
    auth = ClientAuth(settings.oidc_client_id, settings.oidc_client_secret.get_secret_value(), method)
    address, headers, body = auth.prepare("POST", description.address("token_endpoint"), dict(FORM), body)
    status, found = ask(identity.client, "POST", address, content=body, headers=headers)
    if status != 200 and status < 500:
        raise refused("code_refused", "The identity provider did not take the sign-in's code.")
    if status != 200 or not isinstance(found.get("id_token"), str):
        raise unavailable(f"it answers {status} to a code, without an ID token")
    return found


def _completed(
    identity: Identity, description: Description, claims: dict[str, Any], access_token: object
) -> Mapping[str, Any]:
    """Add what the provider's userinfo says, where the ID token lacks a claim that the settings name."""
    address = description.address("userinfo_endpoint")
    if not identity.lacks(claims) or address is None or not isinstance(access_token, str):
        return claims
    status, more = ask(identity.client, "GET", address, headers={"Authorization": f"Bearer {access_token}"})
    # It may be another account's: then nothing in it counts.
    if status != 200 or more.get("sub") != claims["sub"]:
        return claims
    return {**more, **claims}
