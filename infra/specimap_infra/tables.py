"""Tables of the database. Rows that belong to an acquisition or a job are deleted with it."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column

from specimap_infra.database import utc_now

JOB_STATES = ("queued", "running", "succeeded", "failed", "cancelled")
FINAL_STATES = ("succeeded", "failed", "cancelled")
PRIORITIES = {"intraoperative": 1, "routine": 5, "research": 9}
SCOPES = ("upload", "read", "label", "intraoperative", "admin")
ROLES = ("photo", "cube", "white", "dark")
QUEUED = sa.text("state = 'queued'")
"""Condition of the index of queued jobs. A query uses that index where it has the state as text too, not as a value."""


class UtcDateTime(sa.types.TypeDecorator[datetime.datetime]):
    """Aware datetimes in UTC on every database; SQLite keeps no zone of its own."""

    impl = sa.DateTime
    cache_ok = True

    def process_bind_param(self, value: datetime.datetime | None, dialect: sa.Dialect) -> datetime.datetime | None:
        """Convert to naive UTC for the database."""
        return None if value is None else value.astimezone(datetime.UTC).replace(tzinfo=None)

    def process_result_value(self, value: datetime.datetime | None, dialect: sa.Dialect) -> datetime.datetime | None:
        """Convert to aware UTC for the program."""
        return None if value is None else value.replace(tzinfo=datetime.UTC)


class Base(DeclarativeBase):
    """Root of the tables; JSON columns are plain JSON on both databases."""

    type_annotation_map = {  # noqa: RUF012 - SQLAlchemy's own interface
        dict[str, Any]: sa.JSON,
        list[str]: sa.JSON,
        list[Any]: sa.JSON,
        datetime.datetime: UtcDateTime,
    }
    metadata = sa.MetaData(
        naming_convention={
            "ix": "ix_%(column_0_label)s",
            "uq": "uq_%(table_name)s_%(column_0_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s_%(referred_table_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


def _project_of_acquisition(context: Any) -> str:
    """Give a new row the project of its acquisition, which never changes."""
    acquisition_id = context.get_current_parameters()["acquisition_id"]
    query = sa.select(Acquisition.project_id).where(Acquisition.id == acquisition_id)
    return context.connection.scalar(query) or ""


def _in_project() -> Any:
    """A copy of the acquisition's, for lists: an index in their order finds the few rows of a small project."""
    return mapped_column(default=_project_of_acquisition, server_default=sa.text("''"))


def _owned_by(table: str, **options: Any) -> Any:
    return mapped_column(sa.ForeignKey(f"{table}.id", ondelete="CASCADE"), index=True, **options)


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
    """A session of a person who signed in with a key on a page; only the hash of its token is kept."""

    __tablename__ = "sessions"

    id: Mapped[str] = mapped_column(primary_key=True)
    """SHA-256 of the token that the browser holds as a cookie."""
    key_id: Mapped[str] = _owned_by("api_keys")
    share_id: Mapped[str | None] = mapped_column(index=True)
    """The share whose link made it: it sees that share's cloud alone."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    expires_at: Mapped[datetime.datetime] = mapped_column(index=True)


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
    acquisition_id: Mapped[str] = _owned_by("acquisitions")
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
    acquisition_id: Mapped[str] = _owned_by("acquisitions")
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


class Job(Base):
    """A run of the pipeline on an acquisition. ``id`` is the workflow's id at the job engine too."""

    __tablename__ = "jobs"
    __table_args__ = (
        sa.UniqueConstraint("created_by", "idempotency_key"),
        sa.Index("ix_jobs_project_id", "project_id", "id"),
        sa.Index("ix_jobs_queued", "priority", "created_at", "id", postgresql_where=QUEUED, sqlite_where=QUEUED),
    )

    id: Mapped[str] = mapped_column(primary_key=True)
    acquisition_id: Mapped[str] = _owned_by("acquisitions")
    project_id: Mapped[str] = _in_project()
    settings: Mapped[dict[str, Any]]
    priority: Mapped[int]
    state: Mapped[str] = mapped_column(index=True)
    stage: Mapped[str | None]
    progress: Mapped[float] = mapped_column(default=0.0)
    """Share of the running stage, 0 to 1."""
    error: Mapped[dict[str, Any] | None]
    """Code, message, advice and details of the failure."""
    starts: Mapped[int] = mapped_column(default=0)
    """How often a worker took it up."""
    setbacks: Mapped[dict[str, Any]] = mapped_column(default=dict, server_default=sa.text("'{}'"))
    """Of :mod:`specimap_infra.setbacks`, since the last finished stage."""
    executor: Mapped[str | None]
    """The worker that may write to this row: one that lost its lease finds another's name here."""
    idempotency_key: Mapped[str | None]
    """Of jobs from before :class:`RepeatableRequest`; nobody writes or reads it."""
    request_hash: Mapped[str]
    correlation_id: Mapped[str]
    rerun_of: Mapped[str | None]
    webhook: Mapped[dict[str, Any] | None]
    seconds: Mapped[dict[str, Any]] = mapped_column(default=dict)
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    started_at: Mapped[datetime.datetime | None]
    finished_at: Mapped[datetime.datetime | None]
    created_by: Mapped[str]


class RepeatableRequest(Base):
    """A request with an idempotency key: sent again, it finds what it made. Kept for some days."""

    __tablename__ = "repeatable_requests"

    key_id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    """The idempotency key, a name that the client gave."""
    request_hash: Mapped[str]
    object_id: Mapped[str]
    salt: Mapped[str]
    """Of the secret of a key that the request made: with it, and the key that made the request, it is shown again."""
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)


class JobEvent(Base):
    """An event of a job: state, progress or log line. Clients resume after the number ``seq``."""

    __tablename__ = "job_events"

    job_id: Mapped[str] = mapped_column(sa.ForeignKey("jobs.id", ondelete="CASCADE"), primary_key=True)
    seq: Mapped[int] = mapped_column(primary_key=True)
    type: Mapped[str]
    """``state``, ``progress`` or ``log``."""
    data: Mapped[dict[str, Any]]
    at: Mapped[datetime.datetime] = mapped_column(default=utc_now)


class Artefact(Base):
    """The result of a finished stage, found again by the hash of its inputs."""

    __tablename__ = "artefacts"
    __table_args__ = (sa.UniqueConstraint("acquisition_id", "stage", "key"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    acquisition_id: Mapped[str] = _owned_by("acquisitions")
    stage: Mapped[str]
    key: Mapped[str]
    storage_key: Mapped[str]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    seconds: Mapped[float]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)


class CloudRow(Base):
    """A finished result: a folder ``prefix`` in the storage with cloud.zarr, mesh.ply, report.json and others."""

    __tablename__ = "clouds"
    __table_args__ = (sa.Index("ix_clouds_project_id", "project_id", "id"),)

    id: Mapped[str] = mapped_column(primary_key=True)
    job_id: Mapped[str] = _owned_by("jobs", unique=True)
    acquisition_id: Mapped[str] = _owned_by("acquisitions")
    project_id: Mapped[str] = _in_project()
    prefix: Mapped[str]
    points: Mapped[int]
    bands: Mapped[int]
    size: Mapped[int] = mapped_column(sa.BigInteger)
    report: Mapped[dict[str, Any]]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)


class Share(Base):
    """A link that shows one cloud to people without a key; only the hash of its secret is kept."""

    __tablename__ = "shares"

    id: Mapped[str] = mapped_column(primary_key=True)
    cloud_id: Mapped[str] = _owned_by("clouds")
    name: Mapped[str]
    secret_hash: Mapped[str]
    created_at: Mapped[datetime.datetime] = mapped_column(default=utc_now)
    created_by: Mapped[str]
    """The key that made it, with which it ends."""
    expires_at: Mapped[datetime.datetime]
    revoked_at: Mapped[datetime.datetime | None]
    last_used_at: Mapped[datetime.datetime | None]


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
    cloud_id: Mapped[str] = _owned_by("clouds")
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


class Delivery(Base):
    """A webhook to be delivered, and the state of its delivery."""

    __tablename__ = "deliveries"

    id: Mapped[str] = mapped_column(primary_key=True)
    job_id: Mapped[str] = _owned_by("jobs")
    state: Mapped[str]
    """``pending``, ``delivered`` or ``given_up``."""
    attempts: Mapped[int] = mapped_column(default=0)
    next_at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    last_status: Mapped[str | None]


class Lease(Base):
    """The heartbeat of a worker, in seconds of the database's clock."""

    __tablename__ = "leases"

    executor: Mapped[str] = mapped_column(primary_key=True)
    host: Mapped[str]
    kind: Mapped[str]
    started: Mapped[float]
    heartbeat: Mapped[float]


class AuditEntry(Base):
    """An entry of the audit trail: which key did what to which object. It outlives the object."""

    __tablename__ = "audit"
    __table_args__ = (sa.Index("ix_audit_project_id", "project_id", "id"),)

    id: Mapped[int] = mapped_column(sa.BigInteger().with_variant(sa.Integer, "sqlite"), primary_key=True)
    at: Mapped[datetime.datetime] = mapped_column(default=utc_now, index=True)
    key_id: Mapped[str]
    project_id: Mapped[str]
    """The project of the target."""
    action: Mapped[str]
    target: Mapped[str] = mapped_column(index=True)
    details: Mapped[dict[str, Any]]
    correlation_id: Mapped[str]
