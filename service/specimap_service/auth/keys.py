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
from specimap_infra.tables import SCOPES, ApiKey, Share
from specimap_service.auth import shares
from specimap_service.auth.credentials import Credential, secret_hash
from specimap_service.auth.sessions import session_of
from specimap_service.errors import UnauthorizedError

KEPT_SECONDS = 2.0
"""How long a looked-up key is trusted before the database is asked again: the delay of a revocation."""
USED_EVERY = datetime.timedelta(minutes=1)
PREFIX = "spk"


@dataclass(frozen=True)
class Principal:
    """The key of a request, or the share by whose link somebody came."""

    key_id: str
    """The key's id, the share's for a share: each has turns, a rate and lines in the log of its own."""
    project_id: str
    scopes: frozenset[str]
    rate_per_minute: int
    quota_bytes: int
    session_id: str | None = None
    """The session that the request belongs to, where it comes from a person who signed in with the key."""
    cloud_id: str | None = None
    """The one cloud that a share shows; None for a key."""

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
        secret_hash=secret_hash(secret),
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


class Keyring:
    """Keys, and sessions made with them, looked up in the database and trusted for two seconds."""

    def __init__(self, database: Database, rate_per_minute: int, quota_bytes: int) -> None:
        self._database = database
        self._defaults = rate_per_minute, quota_bytes
        self._kept: dict[str, tuple[float, Principal]] = {}
        self._lock = threading.Lock()

    def principal(self, credential: Credential) -> Principal:
        """Return the principal of a key, a session or a share.

        Raises:
            UnauthorizedError: the key or the share is unknown, expired or revoked, or the session has ended; the error
                does not say which.
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
            share: Share | None = None
            session_id: str | None = None
            if credential.kind == "key":
                key = _key_of(session, credential.secret)
            elif credential.kind == "share":
                share, key = _share_of(session, credential.secret)
            else:
                session_id, share, key = _of_session(session, credential.secret)
            used: ApiKey | Share = share or key
            if used.last_used_at is None or utc_now() - used.last_used_at > USED_EVERY:
                used.last_used_at = utc_now()
            return Principal(
                used.id,
                key.project_id,
                frozenset(key.scopes) if share is None else shares.SCOPES,
                key.rate_per_minute or self._defaults[0],
                key.quota_bytes or self._defaults[1],
                session_id,
                None if share is None else share.cloud_id,
            )


def _key_of(session: Session, key: str) -> ApiKey:
    prefix, _, rest = key.partition("_")
    name, _, secret = rest.partition("_")
    row = session.get(ApiKey, f"key_{name}") if prefix == PREFIX else None
    # Compared even where there is no such key, so that the time taken gives nothing away.
    same = hmac.compare_digest(secret_hash(secret), row.secret_hash if row else "0" * 64)
    if row is None or not same or not _is_valid(row):
        raise UnauthorizedError(
            "The key is not valid: unknown, expired or revoked.",
            advice="Ask whoever runs the service for a key; `specimap keys create` makes one.",
        )
    return row


def _share_of(session: Session, token: str) -> tuple[Share, ApiKey]:
    share = shares.share_of(session, token)
    key = None if share is None else shares.maker_of(session, share)
    if share is None or key is None or not shares.is_open(share) or not _is_valid(key):
        raise UnauthorizedError(
            "The link is not valid: unknown, expired or revoked.", advice="Ask whoever sent it for a new one."
        )
    return share, key


def _of_session(session: Session, token: str) -> tuple[str, Share | None, ApiKey]:
    found = session_of(session, token)
    if found is not None and _is_valid(found[1]):
        row, key = found
        share = None if row.share_id is None else session.get(Share, row.share_id)
        if row.share_id is None or (share is not None and shares.is_open(share)):
            return row.id, share, key
    raise UnauthorizedError("The session has ended.", advice="Sign in again, or open the link again.")


def _is_valid(row: ApiKey) -> bool:
    return row.revoked_at is None and (row.expires_at is None or row.expires_at > utc_now())
