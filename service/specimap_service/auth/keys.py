"""Keys with scopes, and the sessions that stand for them. A key is ``spk_<id>_<secret>`` in ``Authorization: Bearer``,
never in a URL."""

from __future__ import annotations

import datetime
import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

from sqlalchemy.orm import Session

from specimap_infra.database import Database, utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import SCOPES, ApiKey
from specimap_service.auth.credentials import Credential
from specimap_service.auth.sessions import session_of
from specimap_service.errors import UnauthorizedError

KEPT_SECONDS = 2.0
"""How long a looked-up key is trusted before the database is asked again: the delay of a revocation."""
USED_EVERY = datetime.timedelta(minutes=1)
PREFIX = "spk"


@dataclass(frozen=True)
class Principal:
    """The key of a request."""

    key_id: str
    project_id: str
    scopes: frozenset[str]
    rate_per_minute: int
    quota_bytes: int
    session_id: str | None = None
    """The session that the request belongs to, where it comes from a person who signed in with the key."""

    @property
    def is_admin(self) -> bool:
        """Whether the key has all scopes and sees all projects."""
        return "admin" in self.scopes

    def may(self, scope: str) -> bool:
        """Return whether the key has a scope."""
        return self.is_admin or scope in self.scopes


def checked_name(name: str) -> str:
    """Return a key's name. Raises ValueError for one that a terminal or a database would not show as it is."""
    if not 1 <= len(name) <= 100 or not name.isprintable():
        raise ValueError("a name has 1 to 100 characters, none of them a control character")
    return name


def new_key(
    name: str,
    scopes: Sequence[str],
    *,
    project_id: str,
    expires_at: datetime.datetime | None = None,
    rate_per_minute: int | None = None,
    quota_bytes: int | None = None,
    secret: str | None = None,
) -> tuple[ApiKey, str]:
    """Make a row to store, and the key itself, which is kept nowhere. ``secret``: 64 hexadecimal digits, or random."""
    row_id, secret = new_id("key"), secret or secrets.token_hex(32)
    row = ApiKey(
        id=row_id,
        project_id=project_id,
        name=name,
        secret_hash=_hash(secret),
        scopes=[s for s in SCOPES if s in scopes],
        created_at=utc_now(),
        expires_at=expires_at,
        rate_per_minute=rate_per_minute,
        quota_bytes=quota_bytes,
    )
    return row, key_text(row_id, secret)


def key_text(row_id: str, secret: str) -> str:
    """Write a key."""
    return f"{PREFIX}_{row_id.removeprefix('key_')}_{secret}"


def derived_secret(maker: Credential, salt: str) -> str:
    """Return the secret of a key that another key, or a session of one, makes: the same for the same maker and salt.

    Neither what the database keeps nor the maker alone gives it: the salt goes when the request is kept no longer, and
    of a session's token, as of a key, only a hash is kept.
    """
    return hmac.new(maker.secret.encode(), salt.encode(), hashlib.sha256).hexdigest()


def is_secret_of(row: ApiKey, secret: str) -> bool:
    """Return whether a key has this secret."""
    return hmac.compare_digest(_hash(secret), row.secret_hash)


def _hash(secret: str) -> str:
    # 256 random bits need no slow hash: there is nothing to guess.
    return hashlib.sha256(secret.encode()).hexdigest()


class Keyring:
    """Keys, and sessions made with them, looked up in the database and trusted for two seconds."""

    def __init__(self, database: Database, rate_per_minute: int, quota_bytes: int) -> None:
        self._database = database
        self._defaults = rate_per_minute, quota_bytes
        self._kept: dict[str, tuple[float, Principal]] = {}
        self._lock = threading.Lock()

    def principal(self, credential: Credential) -> Principal:
        """Return the principal of a key or of a session.

        Raises:
            UnauthorizedError: the key is unknown, expired or revoked, or the session has ended; the error does not say
                which.
        """
        found = self.trusted(credential)
        if found is not None:
            return found
        principal = self._look_up(credential)
        with self._lock:
            if len(self._kept) > 10_000:
                self._kept.clear()
            self._kept[credential.fingerprint] = time.monotonic(), principal
        return principal

    def trusted(self, credential: Credential) -> Principal | None:
        """Return the principal of a credential that was looked up a moment ago; asks no database."""
        with self._lock:
            found = self._kept.get(credential.fingerprint)
        return found[1] if found is not None and time.monotonic() - found[0] < KEPT_SECONDS else None

    def trusted_seconds(self, credential: Credential) -> float:
        """Return for how much longer a credential is trusted before it is looked up again."""
        with self._lock:
            found = self._kept.get(credential.fingerprint)
        return 0.0 if found is None else max(0.0, found[0] + KEPT_SECONDS - time.monotonic())

    def forget(self) -> None:
        """Look every key and session up again."""
        with self._lock:
            self._kept.clear()

    def _look_up(self, credential: Credential) -> Principal:
        with self._database.session() as session:
            if credential.kind == "key":
                row, session_id = _key_of(session, credential.secret), None
            else:
                row, session_id = _key_of_session(session, credential.secret)
            if row.last_used_at is None or utc_now() - row.last_used_at > USED_EVERY:
                row.last_used_at = utc_now()
            return Principal(
                row.id,
                row.project_id,
                frozenset(row.scopes),
                row.rate_per_minute or self._defaults[0],
                row.quota_bytes or self._defaults[1],
                session_id,
            )


def _key_of(session: Session, key: str) -> ApiKey:
    prefix, _, rest = key.partition("_")
    name, _, secret = rest.partition("_")
    row = session.get(ApiKey, f"key_{name}") if prefix == PREFIX else None
    # Compared even where there is no such key, so that the time taken gives nothing away.
    same = hmac.compare_digest(_hash(secret), row.secret_hash if row else "0" * 64)
    if row is None or not same or not _is_valid(row):
        raise UnauthorizedError(
            "The key is not valid: unknown, expired or revoked.",
            advice="Ask whoever runs the service for a key; `specimap keys create` makes one.",
        )
    return row


def _key_of_session(session: Session, token: str) -> tuple[ApiKey, str]:
    found = session_of(session, token)
    if found is None or not _is_valid(found[1]):
        raise UnauthorizedError("The session has ended.", advice="Sign in again.")
    return found[1], found[0].id


def _is_valid(row: ApiKey) -> bool:
    return row.revoked_at is None and (row.expires_at is None or row.expires_at > utc_now())
