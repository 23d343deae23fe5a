"""Sessions: a person signs in with a key once, and the browser holds a token for some hours instead of the key."""

from __future__ import annotations

import datetime
import hashlib
import secrets

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import utc_now
from specimap_infra.tables import ApiKey, Share, SignIn

MOST_SESSIONS = 100
"""Sessions of one key, and of one share: more people than use it at a time. The next one ends the oldest."""


def session_id(token: str) -> str:
    """Return the id of a session: the SHA-256 of its token, which nobody can guess."""
    return hashlib.sha256(token.encode()).hexdigest()


def new_session(session: Session, key: ApiKey, share: Share | None, hours: float) -> tuple[SignIn, str]:
    """Add a session of a key, or of a share that the key made, and return it with its token, which is kept nowhere.

    It ends after ``hours``, or with the key or the share.
    """
    token, now = secrets.token_urlsafe(32), utc_now()
    ends = [now + datetime.timedelta(hours=hours), key.expires_at, None if share is None else share.expires_at]
    row = SignIn(
        id=session_id(token),
        key_id=key.id,
        share_id=None if share is None else share.id,
        created_at=now,
        expires_at=min(end for end in ends if end is not None),
    )
    session.add(row)
    session.flush()
    _end_oldest(session, row)
    return row, token


def _end_oldest(session: Session, row: SignIn) -> None:
    # Without a share, the comparison is with NULL.
    mine = sa.select(SignIn.id).where(SignIn.key_id == row.key_id, SignIn.share_id.is_not_distinct_from(row.share_id))
    older = session.scalars(mine.order_by(SignIn.created_at.desc(), SignIn.id).offset(MOST_SESSIONS)).all()
    if older:
        session.execute(sa.delete(SignIn).where(SignIn.id.in_(older)))


def session_of(session: Session, token: str) -> tuple[SignIn, ApiKey] | None:
    """Return a session that has not expired, and its key, which may no longer be valid; None where there is none."""
    query = sa.select(SignIn, ApiKey).join(ApiKey, ApiKey.id == SignIn.key_id)
    found = session.execute(query.where(SignIn.id == session_id(token), SignIn.expires_at > utc_now())).one_or_none()
    return None if found is None else (found[0], found[1])
