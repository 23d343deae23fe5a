"""The database: SQLite on one machine, PostgreSQL on several; the same code on both."""

from __future__ import annotations

import datetime
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psycopg
import sqlalchemy as sa
from sqlalchemy import event
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.orm import Session, sessionmaker

from specimap_core.atomic import disk_errors
from specimap_infra.availability import Availability
from specimap_infra.errors import DatabaseDamagedError, DatabaseUnavailableError
from specimap_infra.notifications import send
from specimap_infra.postgres import BoundedConnection, make_postgres_engine
from specimap_infra.private_files import make_private

DAMAGED = (sqlite3.SQLITE_NOTADB, sqlite3.SQLITE_CORRUPT)


POOL_SIZE = 10
OVERFLOW = 20


def make_engine(url: str, *, pool_size: int = POOL_SIZE, overflow: int = OVERFLOW) -> sa.Engine:
    """Make an engine for the SQLAlchemy URL, on which writers queue and a dead server is noticed.

    It keeps up to ``pool_size`` connections open, and opens up to ``overflow`` more while all are in use.
    """
    parsed = sa.make_url(url)
    if parsed.get_backend_name() == "sqlite":
        if parsed.database:
            path = Path(parsed.database)
            with disk_errors(path.parent):
                path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
                make_private(path)
        engine = sa.create_engine(parsed, pool_size=pool_size, max_overflow=overflow)

        @event.listens_for(engine, "connect")
        def _set_up(connection: object, _: object) -> None:
            # As the job engine does: writers queue instead of failing in the middle of a transaction.
            connection.isolation_level = "IMMEDIATE"  # type: ignore[attr-defined]
            # What is deleted is overwritten: an erasure leaves nothing in the file.
            pragmas = (
                "busy_timeout=30000",
                "foreign_keys=ON",
                "journal_mode=WAL",
                "synchronous=FULL",
                "secure_delete=ON",
            )
            for pragma in pragmas:
                connection.execute(f"PRAGMA {pragma}")  # type: ignore[attr-defined]

        return engine
    return make_postgres_engine(parsed, pool_size=pool_size, overflow=overflow)


class Database:
    """Sessions on an engine."""

    def __init__(self, engine: sa.Engine) -> None:
        self.engine = engine
        # A file is there or not at once; what takes time there is waiting for another writer.
        self._availability = Availability("database", _refused, refuses=engine.dialect.name != "sqlite")
        self._sessions = sessionmaker(engine, expire_on_commit=False)

    @classmethod
    def open(cls, url: str, *, pool_size: int = POOL_SIZE, overflow: int = OVERFLOW) -> Database:
        """Open without connecting yet, with connections as :func:`make_engine` says."""
        return cls(make_engine(url, pool_size=pool_size, overflow=overflow))

    @contextmanager
    def session(self) -> Iterator[Session]:
        """Open a transaction: committed at the end of the block, rolled back if it raises.

        What :func:`specimap_infra.notifications.tell` was told in it is sent once it is committed.

        Raises:
            DatabaseUnavailableError: the server cannot be reached.
        """
        with self._availability.trying(_is_away), database_errors(), self._sessions() as session:
            with session.begin():
                yield session
            send(session)

    @contextmanager
    def apart(self) -> Iterator[BoundedConnection]:
        """Open a connection of its own to a PostgreSQL, outside of the pool and of transactions, for what waits long.

        Raises:
            DatabaseUnavailableError: the server cannot be reached, also later in the block.
        """
        with self._availability.trying(_is_away), database_errors():
            pooled = self.engine.raw_connection()
        driver = pooled.driver_connection
        pooled.detach()
        assert isinstance(driver, BoundedConnection)
        try:
            with driver:
                driver.autocommit = True
                yield driver
        except psycopg.Error as error:
            raise _unavailable(error) from error

    def check(self) -> None:
        """Raise DatabaseUnavailableError if the database does not answer."""
        with self.session() as session:
            session.execute(sa.text("SELECT 1"))

    def close(self) -> None:
        """Close all connections."""
        self.engine.dispose()


@contextmanager
def database_errors() -> Iterator[None]:
    """Turn lost connections into DatabaseUnavailableError, and a file that is no database into DatabaseDamagedError.

    Other errors pass.
    """
    try:
        yield
    except (OperationalError, sa.exc.TimeoutError) as error:
        raise _unavailable(error) from error
    except DBAPIError as error:
        if error.connection_invalidated:
            raise _unavailable(error) from error
        if getattr(error.orig, "sqlite_errorcode", None) in DAMAGED:
            raise DatabaseDamagedError(
                f"The database's file is damaged or is no database ({error.orig}).",
                advice="Look at SPECIMAP_DATABASE_URL and SPECIMAP_DATA_DIR; "
                "if they name the right one, restore a backup.",
            ) from error
        raise


def _unavailable(error: Exception) -> DatabaseUnavailableError:
    # The driver's text may name hosts and users: it goes to the log with the traceback, not to the caller.
    return DatabaseUnavailableError(
        f"The database does not answer ({type(error).__name__}).", advice="Try again in some seconds."
    )


def _is_away(error: BaseException) -> bool:
    """Whether an error tells that the server is away, not that it is busy or that two writers are at odds."""
    cause = error.__cause__
    if not isinstance(error, DatabaseUnavailableError) or not isinstance(cause, DBAPIError):
        return False
    state = getattr(cause.orig, "sqlstate", None)
    return cause.connection_invalidated or state is None or state.startswith(("08", "57P"))


def _refused() -> DatabaseUnavailableError:
    return DatabaseUnavailableError("The database does not answer.", advice="Try again in some seconds.")


def database_seconds(engine: sa.Engine | sa.Connection) -> sa.ColumnElement[float]:
    """Return the current time in seconds by the database's clock, which all machines share."""
    if engine.dialect.name == "sqlite":
        return sa.literal_column("((julianday('now') - 2440587.5) * 86400.0)", sa.Float())
    return sa.literal_column("extract(epoch from clock_timestamp())::double precision", sa.Float())


def rows_changed(result: sa.Result[Any]) -> int:
    """Return how many rows an UPDATE or DELETE has changed."""
    assert isinstance(result, sa.CursorResult)
    return result.rowcount


def utc_now() -> datetime.datetime:
    """Return the current time in UTC, with its time zone."""
    return datetime.datetime.now(datetime.UTC)
