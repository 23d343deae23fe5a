"""What a request presents to be known: a key or an access token in a header, or the cookie of a session."""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass, field
from typing import Literal, Protocol

from fastapi import Request

from specimap_service.errors import CrossSiteRequestError, UnauthorizedError

COOKIE = "specimap_session"
PAGE_HEADER = "Specimap-Page"
"""A header that the pages of this service send: those of other origins cannot without leave, which none gets."""
SAFE = ("GET", "HEAD", "OPTIONS")
"""Methods that change nothing."""


@dataclass(frozen=True)
class Credential:
    """A key, the token of a session or of a share, or an access token of the identity provider."""

    kind: Literal["key", "session", "share", "token"]
    secret: str = field(repr=False)

    @property
    def fingerprint(self) -> str:
        """A name for it that gives nothing away."""
        return hashlib.sha256(f"{self.kind} {self.secret}".encode()).hexdigest()


class WithSecret(Protocol):
    """A row that keeps the hash of a secret."""

    @property
    def secret_hash(self) -> str:
        """As :func:`secret_hash` makes it."""


def secret_hash(secret: str) -> str:
    """Return what is kept of a secret."""
    # 256 random bits need no slow hash: there is nothing to guess.
    return hashlib.sha256(secret.encode()).hexdigest()


def is_secret_of(row: WithSecret, secret: str) -> bool:
    """Return whether a row keeps the hash of this secret."""
    return hmac.compare_digest(secret_hash(secret), row.secret_hash)


def credential_of(request: Request) -> Credential:
    """Return what a request presents; where it has a key, its cookie does not count.

    Raises:
        UnauthorizedError: there is neither.
        CrossSiteRequestError: there is a cookie, and another site may have made the request.
    """
    header = request.headers.get("authorization")
    if header is None and (token := request.cookies.get(COOKIE)):
        check_page(request)
        return Credential("session", token)
    kind, _, key = (header or "").partition(" ")
    if kind.lower() != "bearer" or not key.strip():
        raise UnauthorizedError("There is no key.", advice="Send it as `Authorization: Bearer <key>`, or sign in.")
    secret = key.strip()
    # A JSON Web Token has three parts with dots between; a key has no dot.
    return Credential("token" if secret.count(".") == 2 else "key", secret)


def check_page(request: Request) -> None:
    """Check that a page of this service, or a person, made a request whose cookie the browser adds by itself.

    Raises:
        CrossSiteRequestError: it changes something and lacks the pages' header, or the browser says that a page of
            another origin made it.
    """
    safe = request.method in SAFE
    # Not every browser says it, and none does on plain HTTP: the header is what counts then.
    site = request.headers.get("sec-fetch-site", "same-origin")
    if site not in (("same-origin", "none") if safe else ("same-origin",)):
        raise CrossSiteRequestError(
            "A page of another site made the request.",
            advice="Use the service's own pages; programs send a key as `Authorization: Bearer <key>`.",
        )
    if not safe and request.headers.get(PAGE_HEADER) != "1":
        raise CrossSiteRequestError(
            f"The header {PAGE_HEADER} is missing.",
            advice=f"Send `{PAGE_HEADER}: 1` with every request of a session that changes something.",
        )
