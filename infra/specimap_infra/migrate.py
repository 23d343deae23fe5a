"""Bring the database to this version's schema: the job engine's tables and our own."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from dbos import DBOS

from specimap_infra.database import Database, database_errors
from specimap_infra.postgres import unhurried
from specimap_infra.schema_version import refuse_newer
from specimap_infra.tables import Base

LOCK = 7261534
"""Number of the PostgreSQL advisory lock; any number that nothing else in the database uses."""
LOCK_POLL_SECONDS = 0.1


def alembic_config(connection: sa.Connection | None = None) -> Config:
    """Make Alembic's configuration, without a file."""
    config = Config()
    config.set_main_option("script_location", "specimap_infra:migrations")
    config.attributes["connection"] = connection
    return config


def migrate(database: Database) -> None:
    """Create or upgrade all tables; programs that start together wait for each other.

    Raises:
        DatabaseTooNewError: a newer release was there before; nothing was changed.
        DatabaseUnavailableError: the server cannot be reached.
    """
    with database_errors(), exclusive_lock(database.engine):
        refuse_newer(database.engine)
        # The engine's own function, since its client never migrates.
        DBOS.migrate(database.engine.url.render_as_string(hide_password=False))
        with database.engine.connect() as connection, unhurried(connection), whole(connection):
            command.upgrade(alembic_config(connection), "head")


@contextmanager
def whole(connection: sa.Connection) -> Iterator[None]:
    """Make a transaction of a migration: all of it or none."""
    if connection.dialect.name != "sqlite":
        with connection.begin():
            yield
        return
    # SQLite changes a table by dropping it for a changed copy. With foreign keys, the drop would delete the
    # rows of other tables that refer to it. The switch works outside of a transaction only.
    connection.exec_driver_sql("PRAGMA foreign_keys=OFF")
    try:
        # Without this, the driver would begin a transaction at the first write of rows, after tables were changed.
        connection.exec_driver_sql("BEGIN IMMEDIATE")
        yield
        for table in Base.metadata.tables.keys() & set(sa.inspect(connection).get_table_names()):
            if connection.exec_driver_sql(f"PRAGMA foreign_key_check({table})").first():
                raise RuntimeError(f"the migration breaks references of the table {table}")
        connection.commit()
    except BaseException:
        connection.rollback()
        raise
    finally:
        connection.exec_driver_sql("PRAGMA foreign_keys=ON")


@contextmanager
def exclusive_lock(engine: sa.Engine) -> Iterator[None]:
    """Hold a lock on the database that only one program can hold at a time."""
    if engine.dialect.name == "sqlite":
        file = engine.url.database
        if not file:
            yield
            return
        # Who may open it could hold it.
        private = partial(os.open, mode=0o600)
        with open(Path(file).with_suffix(".lock"), "w", encoding="ascii", opener=private) as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        return
    # Outside a transaction: the engine builds indexes concurrently, which waits for open ones.
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        # Asked for again and again: a statement that waits holds a snapshot, and a concurrent build of an index waits
        # for all snapshots, so the holder of the lock and those who wait for it would wait for each other.
        while not connection.scalar(sa.text("SELECT pg_try_advisory_lock(:n)"), {"n": LOCK}):
            time.sleep(LOCK_POLL_SECONDS)
        try:
            yield
        finally:
            connection.execute(sa.text("SELECT pg_advisory_unlock(:n)"), {"n": LOCK})
