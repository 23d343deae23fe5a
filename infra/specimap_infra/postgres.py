"""Connections to PostgreSQL that never wait without end: a server or a network that hangs is like one that is gone."""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import psycopg
import sqlalchemy as sa
from psycopg import Notify
from psycopg.abc import PQGen
from sqlalchemy import event

CONNECT_SECONDS = 5
ANSWER_SECONDS = 12.0
"""Longest wait for the answer to one statement; ours take milliseconds, and wait for locks that are held as long."""
CONNECT_ARGUMENTS = {
    "connect_timeout": CONNECT_SECONDS,
    # What the kernel can notice by itself: data that nobody acknowledges, and a peer that is silently gone.
    "tcp_user_timeout": 10_000,
    "keepalives_idle": 5,
    "keepalives_interval": 3,
    "keepalives_count": 3,
    # A frozen worker gives up the rows that it locked.
    "options": "-c idle_in_transaction_session_timeout=60000",
}
Value = TypeVar("Value")


class BoundedConnection(psycopg.Connection[Any]):
    """A connection that closes itself where an answer takes longer than ``answer_seconds``."""

    answer_seconds: float | None = ANSWER_SECONDS

    def wait(self, gen: PQGen[Value], interval: float = 0.1, timeout: float | None = None) -> Value:
        """Wait for an answer.

        Raises:
            psycopg.OperationalError: there was none in time; the connection is closed, since its state is unknown.
        """
        limit = self.answer_seconds if timeout is None else timeout
        try:
            return super().wait(gen, interval, limit)
        except psycopg.errors._WaitTimeout as error:
            if timeout is not None:
                raise
            self.pgconn.finish()
            raise psycopg.OperationalError(f"The server did not answer within {limit:.0f} s.") from error

    def notifies(self, *, timeout: float | None = None, stop_after: int | None = None) -> Generator[Notify]:
        """Wait for notifications, which may never come."""
        with self.unhurried():
            yield from super().notifies(timeout=timeout, stop_after=stop_after)

    @contextmanager
    def unhurried(self) -> Iterator[None]:
        """Wait without end in the block."""
        self.answer_seconds = None
        try:
            yield
        finally:
            self.answer_seconds = ANSWER_SECONDS


def make_postgres_engine(url: sa.URL, *, pool_size: int, overflow: int) -> sa.Engine:
    """Make an engine of such connections."""
    engine = sa.create_engine(
        url,
        pool_size=pool_size,
        max_overflow=overflow,
        pool_timeout=CONNECT_SECONDS,
        pool_pre_ping=True,
        connect_args=CONNECT_ARGUMENTS,
    )

    @event.listens_for(engine, "do_connect")
    def _connect(_dialect: object, _record: object, arguments: list[Any], options: dict[str, Any]) -> Any:
        return BoundedConnection.connect(*arguments, **options)

    return engine


@contextmanager
def unhurried(connection: sa.Connection) -> Iterator[None]:
    """Let statements on a connection take any time in the block: those that change tables, say."""
    driver = connection.connection.driver_connection
    if not isinstance(driver, BoundedConnection):
        yield
        return
    with driver.unhurried():
        yield
