"""Keys with scopes, people with roles, and the sessions that stand for them.

A key is ``spk_<id>_<secret>`` in ``Authorization: Bearer``, never in a URL.
"""

from __future__ import annotations

import datetime
import hashlib
import hmac
import secrets
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import Database, utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import SCOPES, ApiKey, CloudRow, Person, Share
from specimap_service.auth import shares
from specimap_service.auth.credentials import Credential, secret_hash
from specimap_service.auth.people import Granted
from specimap_service.auth.permissions import ALL_PROJECTS, of_roles, of_scopes, scopes_within
from specimap_service.auth.sessions import session_of
from specimap_service.errors import UnauthorizedError

KEPT_SECONDS = 2.0
"""How long a looked-up key is trusted before the database is asked again: the delay of a revocation."""
USED_EVERY = datetime.timedelta(minutes=1)
PREFIX = "spk"


@dataclass(frozen=True)
class Principal:
    """The key of a request, the person who signed in, or the share by whose link somebody came."""

    key_id: str
    """The id of the key, the person or the share: each has turns, a rate and lines in the log of its own."""
    project_ids: tuple[str, ...]
    """Its projects, sorted: a key has one, a person as many as the identity provider gives it."""
    permissions: frozenset[str]
    scopes: tuple[str, ...]
    """Of a key; of a person, those that its permissions make up."""
    rate_per_minute: int
    quota_bytes: int
    session_id: str | None = None
    """The session that the request belongs to, where it comes from a page."""
    cloud_id: str | None = None
    """The one cloud that a share shows; None for a key."""
    roles: tuple[str, ...] = ()
    """Of a person."""

    @property
    def is_admin(self) -> bool:
        """Whether it sees all projects."""
        return ALL_PROJECTS in self.permissions

    @property
    def is_person(self) -> bool:
        """Whether it comes from the identity provider."""
        return self.key_id.startswith("person_")

    def may(self, permission: str) -> bool:
        """Return whether it has a permission of :mod:`specimap_service.auth.permissions`."""
        return permission in self.permissions


class TokenReader(Protocol):
    """Reads access tokens of an identity provider."""

    def of_token(self, token: str) -> Granted:
        """Return whose it is. Raises UnauthorizedError, IdentityUnavailableError."""


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
    """Keys, sessions and tokens, looked up and trusted for two seconds."""

    def __init__(
        self, database: Database, rate_per_minute: int, quota_bytes: int, tokens: TokenReader | None = None
    ) -> None:
        self._database = database
        self._tokens = tokens
        self._defaults = rate_per_minute, quota_bytes
        self._kept: dict[str, tuple[float, Principal]] = {}
        self._lock = threading.Lock()

    def principal(self, credential: Credential) -> Principal:
        """Return the principal of a key, a session, a share or an access token.

        Raises:
            UnauthorizedError: the key or the share is unknown, expired or revoked, or the session has ended; the error
                does not say which. Of a token it says why.
            IdentityUnavailableError: the provider's keys are not known, and it does not answer.
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
        if credential.kind == "token":
            return self._of_token(credential.secret)
        with self._database.session() as session:
            if credential.kind == "key":
                return self._of_key(_key_of(session, credential.secret))
            if credential.kind == "share":
                return self._of_share(session, _share_of(session, credential.secret))
            return self._of_session(session, credential.secret)

    def _of_session(self, session: Session, token: str) -> Principal:
        row = session_of(session, token)
        if row is not None and row.share_id is not None:
            share = session.get(Share, row.share_id)
            if share is not None and shares.is_open(share) and _is_valid(shares.maker_of(session, share)):
                return self._of_share(session, share, row.id)
        elif row is not None:
            holder = session.get(ApiKey, row.key_id) if row.key_id else session.get(Person, row.person_id)
            if holder is not None and _is_valid(holder):
                if isinstance(holder, ApiKey):
                    return self._of_key(holder, row.id)
                return self._of_person(holder, Granted.of_session(row), row.id)
        raise UnauthorizedError("The session has ended.", advice="Sign in again, or open the link again.")

    def _of_key(self, key: ApiKey, session_id: str | None = None) -> Principal:
        _note_use(key)
        return Principal(
            key.id,
            (key.project_id,),
            of_scopes(key.scopes),
            tuple(key.scopes),
            key.rate_per_minute or self._defaults[0],
            key.quota_bytes or self._defaults[1],
            session_id,
        )

    def _of_share(self, session: Session, share: Share, session_id: str | None = None) -> Principal:
        _note_use(share)
        maker = shares.maker_of(session, share)
        project = session.scalar(sa.select(CloudRow.project_id).where(CloudRow.id == share.cloud_id))
        limits = (maker.rate_per_minute, maker.quota_bytes) if isinstance(maker, ApiKey) else (None, None)
        return Principal(
            share.id,
            (project or "",),
            of_scopes(shares.SCOPES),
            shares.SCOPES,
            limits[0] or self._defaults[0],
            limits[1] or self._defaults[1],
            session_id,
            share.cloud_id,
        )

    def _of_person(self, person: Person, granted: Granted, session_id: str | None = None) -> Principal:
        _note_use(person)
        permissions = of_roles(granted.roles)
        scopes = tuple(scopes_within(permissions))
        projects = tuple(sorted(granted.project_ids))
        return Principal(person.id, projects, permissions, scopes, *self._defaults, session_id, None, granted.roles)

    def _of_token(self, token: str) -> Principal:
        if self._tokens is None:
            raise _no_key()
        granted = self._tokens.of_token(token)
        with self._database.session() as session:
            person = session.get_one(Person, granted.person_id)
            if not _is_valid(person):
                raise UnauthorizedError(
                    "The account is blocked in Specimap.", advice="Ask whoever runs the service to let it in again."
                )
            return self._of_person(person, granted)


def _note_use(used: ApiKey | Person | Share) -> None:
    if used.last_used_at is None or utc_now() - used.last_used_at > USED_EVERY:
        used.last_used_at = utc_now()


def _no_key() -> UnauthorizedError:
    return UnauthorizedError(
        "The key is not valid: unknown, expired or revoked.",
        advice="Ask whoever runs the service for a key; `specimap keys create` makes one.",
    )


def _key_of(session: Session, key: str) -> ApiKey:
    prefix, _, rest = key.partition("_")
    name, _, secret = rest.partition("_")
    row = session.get(ApiKey, f"key_{name}") if prefix == PREFIX else None
    # Compared even where there is no such key, so that the time taken gives nothing away.
    same = hmac.compare_digest(secret_hash(secret), row.secret_hash if row else "0" * 64)
    if row is None or not same or not _is_valid(row):
        raise _no_key()
    return row


def _share_of(session: Session, token: str) -> Share:
    share = shares.share_of(session, token)
    if share is None or not shares.is_open(share) or not _is_valid(shares.maker_of(session, share)):
        raise UnauthorizedError(
            "The link is not valid: unknown, expired or revoked.", advice="Ask whoever sent it for a new one."
        )
    return share


def _is_valid(row: ApiKey | Person | None) -> bool:
    if isinstance(row, Person):
        return row.blocked_at is None
    return row is not None and row.revoked_at is None and (row.expires_at is None or row.expires_at > utc_now())
