"""Tables of those that use the service: projects, keys, sessions, shares."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base, owned_by


class Project(Base):
    """A group of keys that share their objects; other keys do not see them."""

    __tablename__ = "projects"
    __table_args__ = (sa.UniqueConstraint("name"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)


class ApiKey(Base):
    """A key; only the hash of its secret is kept."""

    __tablename__ = "api_keys"

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(sa.ForeignKey("projects.id"), index=True)
    """The key's project for good: what it made would otherwise change hands with it."""
    name: Mapped[str]
    secret_hash: Mapped[str]
    scopes: Mapped[list[str]]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime.datetime | None]
    revoked_at: Mapped[datetime.datetime | None]
    last_used_at: Mapped[datetime.datetime | None]
    rate_per_minute: Mapped[int | None]
    quota_bytes: Mapped[int | None] = mapped_column(sa.BigInteger)


class SignIn(Base):
    """A session of a person who signed in on a page, with a key or with an identity provider; only the hash of its
    token is kept."""

    __tablename__ = "sessions"

    id: Mapped[str] = mapped_column(primary_key=True)
    """SHA-256 of the token that the browser holds as a cookie."""
    key_id: Mapped[str | None] = owned_by("api_keys")
    """The key that it stands for, or by which the share was made."""
    person_id: Mapped[str | None] = owned_by("people")
    """The person that it is of, or who made the share, where no key stands behind it."""
    granted: Mapped[dict[str, Any] | None]
    """Of a person who signed in: names of roles, ids of projects, as the identity provider said then."""
    share_id: Mapped[str | None] = mapped_column(index=True)
    """The share whose link made it: it sees that share's cloud alone."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime.datetime] = mapped_column(index=True)


class Share(Base):
    """A link that shows one cloud to people without a key; only the hash of its secret is kept."""

    __tablename__ = "shares"

    id: Mapped[str] = mapped_column(primary_key=True)
    cloud_id: Mapped[str] = owned_by("clouds")
    name: Mapped[str]
    secret_hash: Mapped[str]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]
    """The key or the person that made it, with which it ends."""
    expires_at: Mapped[datetime.datetime]
    revoked_at: Mapped[datetime.datetime | None]
    last_used_at: Mapped[datetime.datetime | None]
