"""Tables of the hospital's side: study contexts, and results on their way to an archive."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base, owned_by


class SealedStudy(Base):
    """The study context of an acquisition, encrypted: the one place of patient data."""

    __tablename__ = "studies"

    acquisition_id: Mapped[str] = mapped_column(sa.ForeignKey("acquisitions.id", ondelete="CASCADE"), primary_key=True)
    key_id: Mapped[str]
    """Which key of the settings opens it."""
    sealed: Mapped[str]
    """Of :mod:`specimap_infra.study_keys`."""
    version: Mapped[int] = mapped_column(default=1)
    """Counts the changes of what it says; another key is none."""
    updated_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    updated_by: Mapped[str]


class DicomSet(Base):
    """DICOM objects that are made of a result and sent together. The objects are made anew for each attempt: what
    holds patient data is not kept."""

    __tablename__ = "dicom_sets"

    id: Mapped[str] = mapped_column(primary_key=True)
    cloud_id: Mapped[str] = owned_by("clouds")
    options: Mapped[dict[str, Any]]
    """What is made beyond the first set; empty for the first set."""
    first: Mapped[bool]
    """Whether it is the first set, of which a cloud has one."""
    study_version: Mapped[int]
    """The study context that its objects were last asked for with."""
    state: Mapped[str] = mapped_column(index=True)
    """``waiting``, ``sent``, ``committed`` or ``failed``."""
    attempts: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    """While it waits: when it is due. Once sent: when the archive's commitment is asked for, or has to be there."""
    holder: Mapped[str | None]
    """The sender that works on it, by a name of its own, until ``held_until``."""
    held_until: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    transaction_uid: Mapped[str | None] = mapped_column(index=True)
    """Of the request for the archive's commitment."""
    reason: Mapped[str | None]
    """A code: why the last attempt did not end well."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]
    settled_at: Mapped[datetime.datetime | None] = mapped_column(index=True)
    """When it came to its state."""


class DicomInstance(Base):
    """One object of a set, and the state of its delivery."""

    __tablename__ = "dicom_instances"
    __table_args__ = (sa.UniqueConstraint("set_id", "sop_instance_uid"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    set_id: Mapped[str] = owned_by("dicom_sets")
    number: Mapped[int]
    """Its place in the set."""
    kind: Mapped[str]
    sop_class_uid: Mapped[str]
    sop_instance_uid: Mapped[str] = mapped_column(index=True)
    size: Mapped[int] = mapped_column(sa.BigInteger)
    state: Mapped[str]
    """``waiting``, ``sent``, ``committed`` or ``failed``."""
    attempts: Mapped[int] = mapped_column(default=0)
    """Counted before it is sent: where one was under way when its sender died, the archive may have it."""
    reason: Mapped[str | None]
    sent_at: Mapped[datetime.datetime | None]


class ReceivedStudy(Base):
    """A study of which photos were received: they all go to one acquisition."""

    __tablename__ = "received_studies"

    digest: Mapped[str] = mapped_column(primary_key=True)
    """Of the project and the study's UID, which is kept in the study context alone."""
    acquisition_id: Mapped[str] = owned_by("acquisitions")
