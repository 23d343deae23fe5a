"""The rows of all tables of our own as lines of JSON, out of one database and into another."""

from __future__ import annotations

import datetime
import gzip
import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

import sqlalchemy as sa

from specimap_core.errors import SettingsError
from specimap_core.json_text import json_text
from specimap_infra.backup.manifest import Cancelled
from specimap_infra.database import Database, database_errors
from specimap_infra.postgres import unhurried
from specimap_infra.references import REMAKEABLE, Reference, reference_of
from specimap_infra.schema_version import refuse_newer, revision_of
from specimap_infra.tables import Base, Lease, SignIn, SignInAttempt, UploadPart

BATCH = 500
LEFT_OUT = frozenset({Lease.__tablename__, SignIn.__tablename__, SignInAttempt.__tablename__, UploadPart.__tablename__})
"""Leases belong to workers of the machine that was saved; unfinished uploads are not saved; and a session that somebody
has ended since must not come back, nor a sign-in under way."""


@dataclass
class Snapshot:
    """What was read in one transaction."""

    revision: str
    rows: dict[str, int] = field(default_factory=dict)
    references: list[Reference] = field(default_factory=list)


def dump_rows(database: Database, target: Path, cancelled: Cancelled) -> Snapshot:
    """Write the rows as they are at one moment; programs that write meanwhile are not kept waiting.

    Raises:
        DatabaseTooNewError: the schema is newer than this program.
        SettingsError: the database holds no tables of Specimap.
        DatabaseUnavailableError: the server cannot be reached.
    """
    with database_errors():
        refuse_newer(database.engine)
        with _reading(database.engine) as connection, gzip.open(target, "wt", encoding="utf-8") as file:
            revision = revision_of(connection)
            if revision is None:
                raise SettingsError(
                    "The database holds no data of Specimap.",
                    advice="Use the settings of the service: SPECIMAP_DATA_DIR or SPECIMAP_DATABASE_URL.",
                )
            snapshot = Snapshot(revision)
            for table in own_tables(connection):
                snapshot.rows[table.name] = 0
                query = sa.select(table).order_by(*table.primary_key.columns)
                for row in connection.execution_options(yield_per=BATCH).execute(query).mappings():
                    if snapshot.rows[table.name] % BATCH == 0 and cancelled():
                        return snapshot
                    snapshot.rows[table.name] += 1
                    values = {name: _stored(value) for name, value in row.items()}
                    file.write(json_text([table.name, values], ensure_ascii=False, separators=(",", ":")) + "\n")
                    if (found := reference_of(table.name, row)) is not None:
                        snapshot.references.append(found)
            return snapshot


@contextmanager
def _reading(engine: sa.Engine) -> Iterator[sa.Connection]:
    """Read as the database is at one moment."""
    if engine.dialect.name == "sqlite":
        with engine.connect() as connection:
            # The driver begins transactions for writing only. In WAL mode writers do not wait for a reader.
            connection.exec_driver_sql("BEGIN")
            yield connection
            connection.rollback()
        return
    options = {"isolation_level": "REPEATABLE READ", "postgresql_readonly": True}
    with engine.connect().execution_options(**options) as connection, unhurried(connection):
        yield connection


def own_tables(connection: sa.Connection) -> list[sa.Table]:
    """Return the tables that are ours and kept, as the database has them, each after those that it refers to."""
    there = set(sa.inspect(connection).get_table_names()) & Base.metadata.tables.keys() - LEFT_OUT
    metadata = sa.MetaData()
    metadata.reflect(connection, only=sorted(there))
    return metadata.sorted_tables


def _stored(value: Any) -> Any:
    return value.isoformat() if isinstance(value, datetime.datetime) else value


def load_rows(connection: sa.Connection, source: Path, without: frozenset[str]) -> None:
    """Put the rows of a backup in place of what the tables hold, which have the schema of the backup.

    ``without``: files that the backup lacks; rows whose file can be made again are left out.
    """
    tables = {table.name: table for table in own_tables(connection)}
    # Migrations have written rows.
    for table in reversed(tables.values()):
        connection.execute(table.delete())
    for table in tables.values():
        for column in table.columns:
            if isinstance(column.type, sa.JSON):
                column.type = sa.JSON(none_as_null=bool(column.nullable))
    with gzip.open(source, "rt", encoding="utf-8") as file:
        for name, lines in groupby(map(json.loads, file), key=lambda line: str(line[0])):
            batch: list[dict[str, Any]] = []
            for _, row in lines:
                if row_is_wanted(name, row, without):
                    batch.append(_loaded(tables[name], row))
                if len(batch) == BATCH:
                    connection.execute(tables[name].insert(), batch)
                    batch = []
            if batch:
                connection.execute(tables[name].insert(), batch)
    if connection.dialect.name == "postgresql":
        _advance_counters(connection, tables.values())


def row_is_wanted(table: str, row: dict[str, Any], without: frozenset[str]) -> bool:
    """Return whether a row is restored: not one whose file is missing and can be made again."""
    found = reference_of(table, row)
    return found is None or table not in REMAKEABLE or found.key not in without


def _loaded(table: sa.Table, row: dict[str, Any]) -> dict[str, Any]:
    return {
        name: datetime.datetime.fromisoformat(value)
        if isinstance(value, str) and isinstance(table.columns[name].type, sa.DateTime)
        else value
        for name, value in row.items()
    }


def _advance_counters(connection: sa.Connection, tables: Iterable[sa.Table]) -> None:
    """Let numbers that the database gives continue after the highest there is."""
    for table in tables:
        for column in table.primary_key.columns:
            if not isinstance(column.type, sa.Integer):
                continue
            counter = connection.scalar(sa.select(sa.func.pg_get_serial_sequence(table.name, column.name)))
            last = connection.scalar(sa.select(sa.func.max(column)))
            if counter is not None and last is not None:
                connection.execute(sa.select(sa.func.setval(counter, last)))
