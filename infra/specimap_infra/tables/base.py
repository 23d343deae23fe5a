"""What all tables have: their root, types of columns, and columns that several have."""

from __future__ import annotations

import datetime
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import DeclarativeBase, mapped_column


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
    acquisitions = Base.metadata.tables["acquisitions"].c
    query = sa.select(acquisitions.project_id).where(acquisitions.id == acquisition_id)
    return context.connection.scalar(query) or ""


def in_project() -> Any:
    """A copy of the acquisition's, for lists: an index in their order finds the few rows of a small project."""
    return mapped_column(default=_project_of_acquisition, server_default=sa.text("''"))


def owned_by(table: str, **options: Any) -> Any:
    return mapped_column(sa.ForeignKey(f"{table}.id", ondelete="CASCADE"), index=True, **options)
