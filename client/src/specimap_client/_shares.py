"""Links that show one result to people without a key."""

from __future__ import annotations

import datetime
from dataclasses import dataclass, field
from typing import Any

from specimap_client._decode import Model
from specimap_client._http import Session, path


@dataclass(frozen=True, kw_only=True)
class Share(Model):
    """A link to one result, without its secret. It ends at ``expires_at``, when revoked, and with its maker's key."""

    id: str
    cloud_id: str
    name: str
    created_at: datetime.datetime
    expires_at: datetime.datetime
    revoked_at: datetime.datetime | None = None
    last_used_at: datetime.datetime | None = None


@dataclass(frozen=True, kw_only=True)
class NewShare(Share):
    """A link that was just made; ``token`` and ``link``, which holds it, are shown this once and kept nowhere."""

    raw: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    token: str = field(repr=False)
    link: str = field(default="", repr=False)


def create(session: Session, cloud_id: str, name: str, expires_at: datetime.datetime) -> NewShare:
    """Make a link."""
    body = {"name": name, "expires_at": expires_at.astimezone(datetime.UTC).isoformat()}
    made = session.create(path("clouds", cloud_id, "shares"), body)
    # In the fragment, which no server or proxy sees.
    return NewShare.of({**made, "link": f"{session.url}/#/shared/{made['token']}"})


def list_all(session: Session, cloud_id: str) -> list[Share]:
    """The links to a result, also those that have ended."""
    return [Share.of(item) for item in session.json("GET", path("clouds", cloud_id, "shares"))]


def revoke(session: Session, share: Share) -> None:
    """End a link; it shows nothing within two seconds."""
    session.request("DELETE", path("clouds", share.cloud_id, "shares", share.id))
