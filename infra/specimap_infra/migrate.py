"""Bring the database to this version's schema: the job engine's tables and our own."""

from __future__ import annotations

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import sqlalchemy as sa
from alembic import command
from alembic.config import Config
from dbos import DBOS

from specimap_infra.database import Database, database_errors
from specimap_infra.postgres import unhurried

LOCK = 7261534
"""Number of the PostgreSQL advisory lock; any number that nothing else in the database uses."""


def alembic_config(connection: sa.Connection | None = None) -> Config:
    """Make Alembic's configuration, without a file."""
    config = Config()
    config.set_main_option("script_location", "specimap_infra:migrations")
    config.attributes["connection"] = connection
    return config


def migrate(database: Database) -> None:
    """Create or upgrade all tables; programs that start together wait for each other.

    Raises:
        DatabaseUnavailableError: the server cannot be reached.
    """
    with database_errors(), exclusive_lock(database.engine):
        # The engine's own function, since its client never migrates.
        DBOS.migrate(database.engine.url.render_as_string(hide_password=False))
        with database.engine.begin() as connection, unhurried(connection):
            command.upgrade(alembic_config(connection), "head")


@contextmanager
def exclusive_lock(engine: sa.Engine) -> Iterator[None]:
    """Hold a lock on the database that only one program can hold at a time."""
    if engine.dialect.name == "sqlite":
        file = engine.url.database
        if not file:
            yield
            return
        with open(Path(file).with_suffix(".lock"), "w", encoding="ascii") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        return
    # Outside a transaction: the engine builds indexes concurrently, which waits for open ones.
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        with unhurried(connection):
            connection.execute(sa.text("SELECT pg_advisory_lock(:n)"), {"n": LOCK})
        try:
            yield
        finally:
            connection.execute(sa.text("SELECT pg_advisory_unlock(:n)"), {"n": LOCK})
