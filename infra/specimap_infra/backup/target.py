"""The database and the storage that a backup is restored into: they hold nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import sqlalchemy as sa

from specimap_core.errors import NotFoundError
from specimap_infra.backup.manifest import Entry
from specimap_infra.backup.rows import LEFT_OUT
from specimap_infra.database import Database, database_errors
from specimap_infra.errors import RestoreTargetError
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.references import PLACES
from specimap_infra.schema_version import engine_schema, refuse_newer
from specimap_infra.storage import Storage
from specimap_infra.tables import AuditHead, Base, Project


def sqlite_file(url: str) -> Path | None:
    """Return the file of a SQLite database; None for another kind."""
    parsed = sa.make_url(url)
    return Path(str(parsed.database)) if parsed.get_backend_name() == "sqlite" else None


def refuse_used_database(url: str) -> None:
    """Raise RestoreTargetError where a database holds rows, DatabaseTooNewError where it is of a newer release."""
    file = sqlite_file(url)
    if file is not None and (not file.exists() or file.stat().st_size == 0):
        return
    database = Database.open(url)
    try:
        with database_errors():
            refuse_newer(database.engine)
            refuse_rows(database.engine)
    finally:
        database.close()


def refuse_rows(engine: sa.Engine) -> None:
    """Raise RestoreTargetError where tables hold more than they are made with."""
    with engine.connect() as connection:
        there = set(sa.inspect(connection).get_table_names())
        for table in Base.metadata.sorted_tables:
            if table.name not in there or table.name in LEFT_OUT:
                continue
            query = sa.select(sa.literal(1)).select_from(table).limit(1)
            if table is Project.__table__:
                # Made with the tables.
                query = query.where(Project.id != DEFAULT_PROJECT)
            elif table is AuditHead.__table__:
                query = query.where(AuditHead.seq != 0)
            if connection.execute(query).first() is not None:
                raise _used(f"the database ({table.name})")
        schema = engine_schema(engine.dialect)
        if sa.inspect(connection).has_table("workflow_status", schema=schema):
            workflows = sa.table("workflow_status", schema=schema)
            if connection.execute(sa.select(sa.literal(1)).select_from(workflows).limit(1)).first() is not None:
                raise _used("the database (the queue of jobs)")


def refuse_used_storage(storage: Storage, entries: Sequence[Entry]) -> set[str]:
    """Return the keys that are there already, from a restore of the same backup that was stopped.

    Raises:
        RestoreTargetError: there are others.
    """
    known, present = {entry.key for entry in entries}, set()
    for place in PLACES:
        try:
            for item in storage.list(place):
                if item.key not in known:
                    raise _used(f"the storage ({item.key})")
                present.add(item.key)
        except NotFoundError:
            continue
    return present


def _used(what: str) -> RestoreTargetError:
    return RestoreTargetError(
        f"A backup is restored into an empty service only; {what} holds data already. Nothing was changed.",
        advice="Name another database and storage, or stop the service and remove its data folder first.",
    )
