"""Rows that one of several processes works on at a time: taken when they are due, and due again if that one dies."""

from __future__ import annotations

from typing import Any, TypeVar

import sqlalchemy as sa

from specimap_infra.database import Database, rows_changed
from specimap_infra.tables import Base

Row = TypeVar("Row", bound=Base)


def take_due(database: Database, table: type[Row], due: sa.ColumnElement[bool], **values: Any) -> Row | None:
    """Take the row that has been due longest, and return it as it is then; None where none is due.

    ``table`` has the columns ``next_at`` and ``attempts``, which is raised by one. ``values`` are what else taking it
    changes, after which it must not be ``due``.

    Raises:
        DatabaseUnavailableError: the database failed; nothing was taken, or it is due again later.
    """
    columns: Any = table
    keys = sa.inspect(table).primary_key
    oldest = sa.select(table).where(due).order_by(columns.next_at).limit(1).with_for_update(skip_locked=True)
    while True:
        with database.session() as session:
            row = session.scalars(oldest).first()
            if row is None:
                return None
            before: Any = row
            same = (key == getattr(row, key.name) for key in keys)
            # SQLite locks no row that is read: the first process to change it has it.
            taken = session.execute(
                sa.update(table)
                .where(*same, columns.attempts == before.attempts, due)
                .values(attempts=columns.attempts + 1, **values),
                execution_options={"synchronize_session": False},
            )
            if rows_changed(taken):
                session.refresh(row)
                return row


def wait_seconds(attempt: int, first: float, longest: float) -> float:
    """How long to wait after an attempt: ``first`` seconds after the first one, twice as long each time, up to
    ``longest``."""
    return min(first * 2.0 ** min(attempt - 1, 30), longest)
