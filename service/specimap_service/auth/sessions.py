"""Sessions: a person signs in with a key once, and the browser holds a token for some hours instead of the key."""

from __future__ import annotations

import datetime
import hashlib
import secrets

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import utc_now
from specimap_infra.tables import ApiKey, SignIn

MOST_SESSIONS = 100
"""Sessions of one key: more people than share one. The next one ends the oldest."""


def session_id(token: str) -> str:
    """Return the id of a session: the SHA-256 of its token, which nobody can guess."""
    return hashlib.sha256(token.encode()).hexdigest()


def new_session(session: Session, key: ApiKey, hours: float) -> tuple[SignIn, str]:
    """Add a session of a key, and return it with its token, which is kept nowhere.

    It ends after ``hours``, or with the key.
    """
    token, now = secrets.token_urlsafe(32), utc_now()
    end = now + datetime.timedelta(hours=hours)
    if key.expires_at is not None:
        end = min(end, key.expires_at)
    row = SignIn(id=session_id(token), key_id=key.id, share_id=None, created_at=now, expires_at=end)
    session.add(row)
    session.flush()
    _end_oldest(session, key.id)
    return row, token


def _end_oldest(session: Session, key_id: str) -> None:
    mine = sa.select(SignIn.id).where(SignIn.key_id == key_id, SignIn.share_id.is_(None))
    older = session.scalars(mine.order_by(SignIn.created_at.desc(), SignIn.id).offset(MOST_SESSIONS)).all()
    if older:
        session.execute(sa.delete(SignIn).where(SignIn.id.in_(older)))


def session_of(session: Session, token: str) -> tuple[SignIn, ApiKey] | None:
    """Return a session that has not expired, and its key, which may no longer be valid; None where there is none."""
    query = sa.select(SignIn, ApiKey).join(ApiKey, ApiKey.id == SignIn.key_id)
    found = session.execute(query.where(SignIn.id == session_id(token), SignIn.expires_at > utc_now())).one_or_none()
    return None if found is None else (found[0], found[1])
