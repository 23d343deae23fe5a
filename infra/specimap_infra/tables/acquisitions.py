"""Tables of what was captured: acquisitions, their files, uploads."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base, owned_by


class Acquisition(Base):
    """An acquisition: the captures of one specimen. Its files, jobs and results belong to its project too."""

    __tablename__ = "acquisitions"
    # In the order of lists, so that a page takes no sorting.
    __table_args__ = (sa.Index("ix_acquisitions_project_id", "project_id", "id"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    project_id: Mapped[str] = mapped_column(sa.ForeignKey("projects.id"))
    specimen_id: Mapped[str] = mapped_column(index=True)
    accession_number: Mapped[str | None] = mapped_column(index=True)
    dictionary: Mapped[str]
    edge_mm: Mapped[float]
    notes: Mapped[str]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    created_by: Mapped[str] = mapped_column(index=True)


class StoredFile(Base):
    """A file of an acquisition; ``label`` is its name in results, ``name`` the client's own."""

    __tablename__ = "files"
    __table_args__ = (sa.UniqueConstraint("acquisition_id", "label"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    acquisition_id: Mapped[str] = owned_by("acquisitions")
    role: Mapped[str]
    label: Mapped[str]
    name: Mapped[str]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    sha256: Mapped[str]
    storage_key: Mapped[str]
    state: Mapped[str]
    """``accepted``, or ``refused``: no job uses it, and it should be retaken."""
    judgement: Mapped[dict[str, Any]]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str] = mapped_column(index=True)


class Upload(Base):
    """A resumable upload, under way or ended."""

    __tablename__ = "uploads"

    id: Mapped[str] = mapped_column(primary_key=True)
    acquisition_id: Mapped[str] = owned_by("acquisitions")
    role: Mapped[str]
    name: Mapped[str]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    state: Mapped[str]
    """``open``, ``finished`` (as file ``file_id``), ``failed`` (``error``), ``expired`` or ``terminated``."""
    file_id: Mapped[str | None]
    error: Mapped[dict[str, Any] | None]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime.datetime] = mapped_column(index=True)
    created_by: Mapped[str] = mapped_column(index=True)
    received: Mapped[int] = mapped_column(sa.BigInteger, default=0, server_default=sa.text("0"))
    """Bytes in the storage, where API processes of several machines share uploads."""
    holder: Mapped[str | None]
    """The request that writes to it, by a name of its own, until ``held_until``."""
    held_until: Mapped[float] = mapped_column(default=0.0, server_default=sa.text("0"))
    """In seconds of the database's clock."""
    wanted_at: Mapped[float] = mapped_column(default=0.0, server_default=sa.text("0"))
    """When another request last asked for it, by the same clock."""


class UploadPart(Base):
    """A part of a resumable upload in the storage, where API processes of several machines share uploads."""

    __tablename__ = "upload_parts"

    upload_id: Mapped[str] = mapped_column(sa.ForeignKey("uploads.id", ondelete="CASCADE"), primary_key=True)
    start: Mapped[int] = mapped_column(sa.BigInteger, primary_key=True)
    """Its first byte in the file."""
    size: Mapped[int] = mapped_column(sa.BigInteger)
    storage_key: Mapped[str]
