"""Databases for tests: SQLite in a folder, and PostgreSQL where a server answers (PGHOST, PGPORT, PGUSER, ...)."""

from __future__ import annotations

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path

import psycopg
import pytest
from psycopg import sql

from specimap_infra.database import Database
from specimap_infra.migrate import migrate


def postgres_server() -> psycopg.Connection:
    """A connection to the server's own database; skips the test where none answers."""
    try:
        return psycopg.connect(
            host=os.environ.get("PGHOST", "127.0.0.1"),
            dbname=os.environ.get("PGDATABASE", "postgres"),
            connect_timeout=3,
            autocommit=True,
        )
    except psycopg.OperationalError as error:
        pytest.skip(f"no PostgreSQL server answers: {error}")


@contextmanager
def postgres_url() -> Iterator[str]:
    """URL of an empty database of its own, dropped afterwards."""
    name = f"specimap_test_{uuid.uuid4().hex[:12]}"
    with postgres_server() as server:
        server.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)))
        info = server.info
        account = f"{info.user}:{info.password}" if info.password else info.user
        try:
            yield f"postgresql://{account}@{info.host}:{info.port}/{name}"
        finally:
            server.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name)))


@cache
def _empty_sqlite() -> bytes:
    """A SQLite file with all tables and no rows."""
    with tempfile.TemporaryDirectory() as folder:
        database = Database.open(f"sqlite:///{folder}/empty.db")
        migrate(database)
        with database.engine.connect() as connection:
            connection.exec_driver_sql("PRAGMA wal_checkpoint(TRUNCATE)")
        database.close()
        return Path(folder, "empty.db").read_bytes()


def create_tables(database: Database) -> None:
    """All tables in an empty database: for a new SQLite file as a copy, since migrating takes longer than a test."""
    url = database.engine.url
    path = Path(url.database or "")
    if url.get_backend_name() == "sqlite" and not path.exists():
        path.write_bytes(_empty_sqlite())
    else:
        migrate(database)


@pytest.fixture(params=["sqlite", "postgresql"])
def any_database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[str]:
    """``database_url`` of an empty database, once of each kind."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path / 'test.db'}"
    else:
        with postgres_url() as url:
            yield url


@pytest.fixture
def tables(any_database: str) -> Iterator[Database]:
    """A database of each kind with all tables."""
    database = Database.open(any_database.replace("postgresql://", "postgresql+psycopg://", 1))
    create_tables(database)
    yield database
    database.close()


@pytest.fixture
def sqlite_tables(tmp_path: Path) -> Iterator[Database]:
    """SQLite with all tables, for what does not depend on the kind of database."""
    database = Database.open(f"sqlite:///{tmp_path / 'tables.db'}")
    create_tables(database)
    yield database
    database.close()
