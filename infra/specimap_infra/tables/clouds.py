"""Tables of results: clouds, label layers, exports."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Mapped, mapped_column

from specimap_infra.database import utc_now
from specimap_infra.tables.base import Base, in_project, owned_by


class CloudRow(Base):
    """A finished result: a folder ``prefix`` in the storage with cloud.zarr, mesh.ply, report.json and others."""

    __tablename__ = "clouds"
    __table_args__ = (sa.Index("ix_clouds_project_id", "project_id", "id"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    job_id: Mapped[str] = owned_by("jobs", unique=True)
    acquisition_id: Mapped[str] = owned_by("acquisitions")
    project_id: Mapped[str] = in_project()
    prefix: Mapped[str]
    points: Mapped[int]
    bands: Mapped[int]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    report: Mapped[dict[str, Any]]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)


class LabelVersion(Base):
    """One version of a label layer of a cloud; the highest is the current one."""

    __tablename__ = "labels"

    cloud_id: Mapped[str] = mapped_column(sa.ForeignKey("clouds.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    version: Mapped[int] = mapped_column(primary_key=True)
    kind: Mapped[str]
    """``class`` or ``probability``."""
    classes: Mapped[list[Any]]
    """One object for each class: value, name, colour."""
    made_by: Mapped[dict[str, Any]]
    storage_prefix: Mapped[str]
    sha256: Mapped[str]
    size: Mapped[int] = mapped_column(sa.BigInteger, default=0, server_default=sa.text("0"))
    """Stored bytes; 0 for versions older than the column, which no quota counts."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]


class Export(Base):
    """A file made from a result on request, once."""

    __tablename__ = "exports"
    __table_args__ = (sa.UniqueConstraint("cloud_id", "format"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    cloud_id: Mapped[str] = owned_by("clouds")
    format: Mapped[str]
    state: Mapped[str]
    """The same states as a job's."""
    storage_key: Mapped[str | None]
    size: Mapped[int | None] = mapped_column(sa.BigInteger)
    error: Mapped[dict[str, Any] | None]
    executor: Mapped[str | None]
    labels_hash: Mapped[str] = mapped_column(default="")
    """Hash of the label layers in it, if it holds any: shows whether it is still current."""
    setbacks: Mapped[dict[str, Any]] = mapped_column(default=dict, server_default=sa.text("'{}'"))
    """Of :mod:`specimap_infra.setbacks`."""
    correlation_id: Mapped[str]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]
