"""Tables of legal holds and of erasures."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base


class LegalHold(Base):
    """Keeps an acquisition from being deleted: the reference restricts it, whoever writes to the database."""

    __tablename__ = "legal_holds"

    acquisition_id: Mapped[str] = mapped_column(sa.ForeignKey("acquisitions.id", ondelete="RESTRICT"), primary_key=True)
    reason: Mapped[str]
    """A code, never a text about a person."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]


class Erasure(Base):
    """An erasure of a specimen: what it removes, and its certificate once nothing is left."""

    __tablename__ = "erasures"

    id: Mapped[str] = mapped_column(primary_key=True)
    specimen_hash: Mapped[str] = mapped_column(index=True)
    """Keyed with the signing key: finds the specimen again in a restored backup, and names it to nobody."""
    acquisitions: Mapped[list[str]]
    removal: Mapped[dict[str, Any]]
    """Of :class:`specimap_infra.deletion.Removal`."""
    state: Mapped[str]
    """``running`` while files are removed, then ``done``."""
    certificate: Mapped[dict[str, Any] | None]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]
