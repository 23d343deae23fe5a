"""What the identity provider says of itself, and its keys: fetched when first needed, and kept while it is away."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import httpx
from joserfc.errors import JoseError
from joserfc.jwk import ECKey, OKPKey, RSAKey, import_key

from specimap_infra.logs import logger
from specimap_infra.settings.identity import is_safe_address
from specimap_service.auth.oidc.fetching import ask, unavailable
from specimap_service.errors import IdentityUnavailableError

FRESH_SECONDS = 600.0
"""After which description and keys are fetched again: the delay after which a key that was taken back no longer
counts."""
KEPT_SECONDS = 24 * 3600.0
"""How long they count while the provider does not answer."""
AGAIN_SECONDS = 30.0
"""Shortest time between two fetches, whoever asks for unknown keys."""
FIRST_AGAIN_SECONDS = 3.0
"""The same while nothing is known yet."""
MOST_KEYS = 100
WELL_KNOWN = "/.well-known/openid-configuration"
NEEDED = ("authorization_endpoint", "token_endpoint", "jwks_uri")
PublicKey = RSAKey | ECKey | OKPKey
KIND_OF: dict[str, type[PublicKey]] = {"RS": RSAKey, "PS": RSAKey, "ES": ECKey, "Ed": OKPKey}
"""Kinds of keys by the first letters of the signatures that they check."""


@dataclass(frozen=True)
class Description:
    """The provider's description and its keys, as they were fetched."""

    values: Mapping[str, Any] = field(repr=False)
    keys: tuple[PublicKey, ...] = field(repr=False)

    def address(self, name: str) -> str | None:
        """Return an address that the provider gives, if it is a safe one."""
        found = self.values.get(name)
        return found if isinstance(found, str) and is_safe_address(found.partition("?")[0]) else None

    def says(self, name: str) -> list[str]:
        """Return a list of words that the provider gives."""
        found = self.values.get(name)
        return [word for word in found if isinstance(word, str)] if isinstance(found, list) else []

    def key(self, kid: str | None, algorithm: str) -> PublicKey | None:
        """Return the key of this id that checks such signatures; without an id the one key that does."""
        fit = [key for key in self.keys if _fits(key, algorithm)]
        named = [key for key in fit if key.kid == kid]
        if kid is None and not named:
            return fit[0] if len(fit) == 1 else None
        return named[0] if len(named) == 1 else None


class Provider:
    """The provider's description, looked up. Safe to share between threads."""

    def __init__(self, issuer: str, client: httpx.Client, clock: Callable[[], float] = time.monotonic) -> None:
        self.issuer = issuer
        self._client = client
        self._clock = clock
        self._known: tuple[float, Description] | None = None
        self._tried: float | None = None
        self._fetching = threading.Lock()

    def description(self) -> Description:
        """Return what the provider says of itself.

        Raises:
            IdentityUnavailableError: it is not known, or too old, and the provider does not answer.
        """
        known = self._known
        if known is not None and self._clock() - known[0] < FRESH_SECONDS:
            return known[1]
        return self._renewed()

    def key(self, kid: str | None, algorithm: str) -> PublicKey | None:
        """Return a key of the provider; one that is not known is asked for, though not more often than now and then.

        Raises:
            IdentityUnavailableError: as :meth:`description`.
        """
        return self.description().key(kid, algorithm) or self._renewed().key(kid, algorithm)

    def _renewed(self) -> Description:
        """Fetch the description, unless that was tried a moment ago; keep the one before where it does not come."""
        # While one request fetches, the others go on with what is known, if anything is.
        if self._fetching.acquire(blocking=self._known is None):
            try:
                self._try()
            finally:
                self._fetching.release()
        known = self._known
        if known is None or self._clock() - known[0] > KEPT_SECONDS:
            raise unavailable("it does not answer")
        return known[1]

    def _try(self) -> None:
        now, pause = self._clock(), FIRST_AGAIN_SECONDS if self._known is None else AGAIN_SECONDS
        if self._tried is not None and now - self._tried < pause:
            return
        self._tried = now
        try:
            self._known = now, fetch(self._client, self.issuer)
        except IdentityUnavailableError as error:
            logger().warning("identity provider away", reason=error.message)
        finally:
            self._tried = self._clock()


def fetch(client: httpx.Client, issuer: str) -> Description:
    """Fetch the provider's description and its keys.

    Raises:
        IdentityUnavailableError: it does not answer, or is not the provider that the settings name.
    """
    status, values = ask(client, "GET", issuer.rstrip("/") + WELL_KNOWN)
    if status != 200:
        raise unavailable(f"it answers {status} to {WELL_KNOWN}")
    if values.get("issuer") != issuer:
        raise unavailable("it calls itself by another address than SPECIMAP_OIDC_ISSUER")
    described = Description(values, ())
    for name in NEEDED:
        if described.address(name) is None:
            raise unavailable(f"it gives no {name} that is https")
    status, found = ask(client, "GET", values["jwks_uri"])
    given = found.get("keys")
    if status != 200 or not isinstance(given, list):
        raise unavailable(f"it answers {status} to jwks_uri, without keys")
    keys = tuple(key for key in map(_imported, given[:MOST_KEYS]) if key is not None)
    if not keys:
        raise unavailable("it has no keys that check signatures")
    return Description(values, keys)


def _imported(given: object) -> PublicKey | None:
    """Return a public key that signs; secrets, keys for encryption, and whatever does not read are left out."""
    if not isinstance(given, dict) or given.get("use", "sig") != "sig" or given.get("kty") == "oct":
        return None
    try:
        key = import_key(given)
    except (JoseError, ValueError, TypeError, KeyError):
        return None
    return key if isinstance(key, PublicKey) else None


def _fits(key: PublicKey, algorithm: str) -> bool:
    return type(key) is KIND_OF[algorithm[:2]] and key.get("alg", algorithm) == algorithm
