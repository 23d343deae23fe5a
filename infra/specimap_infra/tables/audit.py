"""Tables of the audit trail: entries, the end of their chain, and how far they were forwarded."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base

UNSEALED = sa.text("seq IS NULL")
"""Condition of the index of entries that are not in the chain yet."""


class AuditEntry(Base):
    """An entry of the audit trail: a key, share or program did an action to an object. It outlives the object.

    Triggers refuse every change of a row but one: the sealer's, which puts the entry into the chain.
    """

    __tablename__ = "audit"
    __table_args__ = (
        sa.Index("ix_audit_project_id", "project_id", "id"),
        sa.Index("ix_audit_unsealed", "id", postgresql_where=UNSEALED, sqlite_where=UNSEALED),
    )

    id: Mapped[int] = mapped_column(sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True)
    at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    key_id: Mapped[str]
    """The actor: a key, a share, a person, or a program by its name; empty where nobody was known."""
    project_id: Mapped[str]
    """The project of the target."""
    action: Mapped[str]
    target: Mapped[str] = mapped_column(index=True)
    details: Mapped[dict[str, Any]]
    """Ids and numbers; never a specimen's id, a patient's data or a name that a client gave."""
    correlation_id: Mapped[str]
    kind: Mapped[str] = mapped_column(default="change", server_default=sa.text("'change'"))
    """``change``, ``access`` (a read, or a request that was refused or failed) or ``service``."""
    outcome: Mapped[str] = mapped_column(default="success", server_default=sa.text("'success'"))
    """``success``, ``refused`` or ``failed``."""
    status: Mapped[int | None]
    """HTTP status, where a request was answered."""
    acquisition_id: Mapped[str | None] = mapped_column(index=True)
    """The acquisition that the target belongs to."""
    address: Mapped[str] = mapped_column(default="", server_default=sa.text("''"))
    """Where the request came from, as ``SPECIMAP_AUDIT_ADDRESSES`` says."""
    count: Mapped[int] = mapped_column(default=1, server_default=sa.text("1"))
    """How many like requests the entry stands for."""
    seq: Mapped[int | None] = mapped_column(sa.BigInteger, unique=True)
    """Place in the chain, from 1 without gaps; null for the moment before the entry is sealed."""
    previous_hash: Mapped[str | None]
    hash: Mapped[str | None]
    """Of :mod:`specimap_infra.audit.records`."""


class AuditHead(Base):
    """The one row that says where the chain of the audit trail ends, and where it begins after the oldest were removed.

    Whoever seals or removes entries locks it.
    """

    __tablename__ = "audit_head"

    id: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    seq: Mapped[int] = mapped_column(sa.BigInteger)
    hash: Mapped[str]
    pruned_seq: Mapped[int] = mapped_column(sa.BigInteger)
    """Entries up to this one may be removed, and most are; the triggers keep all later ones."""
    pruned_hash: Mapped[str]
    salt: Mapped[str]
    """Of the pseudonyms of addresses, where no key of the audit trail is set."""


class AuditCursor(Base):
    """How far the audit trail was forwarded to a destination."""

    __tablename__ = "audit_cursors"

    destination: Mapped[str] = mapped_column(primary_key=True)
    seq: Mapped[int] = mapped_column(sa.BigInteger)
    updated_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
