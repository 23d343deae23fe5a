"""Databases for tests: SQLite in a folder, and PostgreSQL where a server answers (PGHOST, PGPORT, PGUSER, ...)."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from pathlib import Path

import psycopg
import pytest
import sqlalchemy as sa
from psycopg import sql

from bench.service.databases import connect, empty_database
from specimap_infra.database import Database
from specimap_infra.migrate import migrate

TEST_DATABASE = "specimap_test_"
"""How the names of the databases begin that tests make in the server."""


def postgres_server() -> psycopg.Connection:
    """A connection to the server's own database; skips the test where none answers."""
    try:
        return connect()
    except psycopg.OperationalError as error:
        pytest.skip(f"no PostgreSQL server answers: {error}")


@contextmanager
def postgres_url() -> Iterator[str]:
    """URL of an empty database of its own, dropped afterwards."""
    with postgres_server() as server, empty_database(server, TEST_DATABASE) as url:
        yield url


def sqlalchemy_url(url: str) -> str:
    """A ``database_url`` as SQLAlchemy takes it."""
    return url.replace("postgresql://", "postgresql+psycopg://", 1)


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


_at_end = ExitStack()
"""What this process removes when its tests have ended."""


@cache
def _postgres_template() -> str:
    """Name of a PostgreSQL database with all tables and no rows, which nobody is connected to."""
    url = _at_end.enter_context(postgres_url())
    database = Database.open(sqlalchemy_url(url))
    migrate(database)
    database.close()
    return url.rsplit("/", 1)[1]


def pytest_sessionfinish() -> None:
    """Drop the template."""
    _at_end.close()


def create_tables(database: Database) -> None:
    """All tables in an empty database, as a copy: migrating takes longer than most tests.

    One that holds something already, or that no test made, is brought to this version's schema.
    """
    url = database.engine.url
    path, name = Path(url.database or ""), url.database or ""
    if url.get_backend_name() == "sqlite":
        # Opening a database makes its file.
        if not path.exists() or not path.stat().st_size:
            path.write_bytes(_empty_sqlite())
            return
    elif name.startswith(TEST_DATABASE) and not sa.inspect(database.engine).get_table_names():
        database.close()
        with postgres_server() as server:
            server.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name)))
            made = sql.SQL("CREATE DATABASE {} TEMPLATE {}")
            server.execute(made.format(sql.Identifier(name), sql.Identifier(_postgres_template())))
        return
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
    database = Database.open(sqlalchemy_url(any_database))
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
