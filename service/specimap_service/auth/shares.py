"""Shares: links that show one result to people without a key. A share's token is ``sps_<id>_<secret>``."""

from __future__ import annotations

import datetime
import hmac
import secrets

from sqlalchemy.orm import Session

from specimap_infra.database import utc_now
from specimap_infra.ids import new_id
from specimap_infra.tables import ApiKey, Person, Share
from specimap_service.auth.credentials import secret_hash

PREFIX = "sps"
MOST_DAYS = 90
SCOPES = ("read",)
"""What a share permits, on its cloud alone."""


def new_share(
    cloud_id: str, name: str, expires_at: datetime.datetime, *, created_by: str, secret: str | None
) -> tuple[Share, str]:
    """Make a row to store, and the token, which is kept nowhere. ``secret``: 64 hexadecimal digits, or random."""
    share_id, secret = new_id("shr"), secret or secrets.token_hex(32)
    row = Share(
        id=share_id,
        cloud_id=cloud_id,
        name=name,
        secret_hash=secret_hash(secret),
        created_at=utc_now(),
        created_by=created_by,
        expires_at=expires_at,
    )
    return row, share_text(share_id, secret)


def share_text(share_id: str, secret: str) -> str:
    """Write a token."""
    return f"{PREFIX}_{share_id.removeprefix('shr_')}_{secret}"


def share_of(session: Session, token: str) -> Share | None:
    """Return the share of a token, which may no longer be valid; None where there is none."""
    prefix, _, rest = token.partition("_")
    name, _, secret = rest.partition("_")
    row = session.get(Share, f"shr_{name}") if prefix == PREFIX else None
    # Compared even where there is no such share, so that the time taken gives nothing away.
    same = hmac.compare_digest(secret_hash(secret), row.secret_hash if row else "0" * 64)
    return row if same else None


def maker_of(session: Session, share: Share) -> ApiKey | Person | None:
    """Return the key or the person that made a share, which ends with it."""
    if share.created_by.startswith("person_"):
        return session.get(Person, share.created_by)
    return session.get(ApiKey, share.created_by)


def is_open(share: Share) -> bool:
    """Return whether a share is neither revoked nor expired."""
    return share.revoked_at is None and share.expires_at > utc_now()
