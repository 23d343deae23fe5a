"""Sessions: a person signs in once, with a key or an identity provider; the browser holds a token for hours."""

from __future__ import annotations

import datetime
import hashlib
import secrets
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import rows_changed, utc_now
from specimap_infra.tables import ApiKey, Person, Share, SignIn

MOST_SESSIONS = 100
"""Sessions of one key, of a person, of a share: more than are in use at a time. The next one ends the oldest."""


def session_id(token: str) -> str:
    """Return the id of a session: the SHA-256 of its token, which nobody can guess."""
    return hashlib.sha256(token.encode()).hexdigest()


def new_session(
    session: Session,
    holder: ApiKey | Person,
    hours: float,
    *,
    share: Share | None = None,
    granted: dict[str, Any] | None = None,
) -> tuple[SignIn, str]:
    """Add a session of a key or a person, and return it with its token, which is kept nowhere.

    It ends after ``hours``, or with the key or the share. ``share``: one of the holder's, whose cloud alone the session
    sees. ``granted``: what the identity provider gives a person.
    """
    token, now = secrets.token_urlsafe(32), utc_now()
    key = holder if isinstance(holder, ApiKey) else None
    ends = [now + datetime.timedelta(hours=hours)]
    ends += [held.expires_at for held in (key, share) if held is not None and held.expires_at is not None]
    row = SignIn(
        id=session_id(token),
        key_id=None if key is None else key.id,
        person_id=None if key is not None else holder.id,
        granted=granted,
        share_id=None if share is None else share.id,
        created_at=now,
        expires_at=min(ends),
    )
    session.add(row)
    session.flush()
    _end_oldest(session, row)
    return row, token


def _end_oldest(session: Session, row: SignIn) -> None:
    # A comparison with NULL where there is no share, and no key or no person.
    same = (
        column.is_not_distinct_from(getattr(row, column.key))
        for column in (SignIn.key_id, SignIn.person_id, SignIn.share_id)
    )
    mine = sa.select(SignIn.id).where(*same)
    older = session.scalars(mine.order_by(SignIn.created_at.desc(), SignIn.id).offset(MOST_SESSIONS)).all()
    if older:
        session.execute(sa.delete(SignIn).where(SignIn.id.in_(older)))


def end_session(session: Session, row_id: str) -> SignIn | None:
    """End a session by its id; return what it was, None where it has ended already."""
    row = session.get(SignIn, row_id)
    # Two requests may end it at once.
    if row is None or not rows_changed(session.execute(sa.delete(SignIn).where(SignIn.id == row_id))):
        return None
    return row


def session_of(session: Session, token: str) -> SignIn | None:
    """Return a session that has not expired, whose key or person may no longer be valid; None where there is none."""
    return session.scalar(sa.select(SignIn).where(SignIn.id == session_id(token), SignIn.expires_at > utc_now()))
