"""Notifications: heard once what they tell of is committed, and again after an outage."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
import sqlalchemy as sa

from specimap_infra import notifications
from specimap_infra.database import Database
from specimap_infra.notifications import DELIVERIES, QUEUED, Listener, tell
from specimap_infra.tables import Lease
from tests.support.databases import create_tables, postgres_server, postgres_url

Heard = queue.Queue[tuple[str, str]]


@pytest.fixture
def postgres() -> Iterator[Database]:
    """A database with all tables."""
    with postgres_url() as url:
        database = Database.open(url.replace("postgresql://", "postgresql+psycopg://", 1))
        create_tables(database)
        yield database
        database.close()


@contextmanager
def hearing(database: Database, *channels: str) -> Iterator[tuple[Heard, Listener]]:
    """A listener, past what it is told when it begins."""
    heard: Heard = queue.Queue()
    listener = Listener(database, channels, lambda channel, payload: heard.put((channel, payload)))
    listener.start()
    try:
        for channel in channels:
            assert heard.get(timeout=20) == (channel, "")
        yield heard, listener
    finally:
        listener.stop()


def cut(database: Database) -> None:
    """Cut all connections to a database."""
    with postgres_server() as server:
        name = database.engine.url.database
        server.execute("SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s", [name])


def lease(name: str) -> Lease:
    return Lease(executor=name, host="h", kind="cpu", started=0.0, heartbeat=0.0)


def fail_after_telling(database: Database) -> None:
    with database.session() as session:
        tell(session, QUEUED, "never")
        raise RuntimeError("on purpose")


def test_notification_comes_after_the_commit_and_only_then(postgres: Database) -> None:
    with hearing(postgres, QUEUED, DELIVERIES) as (heard, _):
        with pytest.raises(RuntimeError, match="on purpose"):
            fail_after_telling(postgres)
        with postgres.session() as session:
            session.add(lease("a"))
            for _ in range(3):
                tell(session, QUEUED, "jobs")
            tell(session, DELIVERIES)
        # Several of one kind are told once, and nothing of the transaction that was rolled back.
        assert {heard.get(timeout=20), heard.get(timeout=20)} == {(QUEUED, "jobs"), (DELIVERIES, "")}
        with postgres.session() as session:
            assert session.get(Lease, "a") is not None
            tell(session, QUEUED, "last")
        assert heard.get(timeout=20) == (QUEUED, "last")


def test_listener_outlives_a_cut_connection_and_looks_at_everything(postgres: Database) -> None:
    with hearing(postgres, QUEUED, DELIVERIES) as (heard, listener):
        cut(postgres)
        # What was told meanwhile was not heard, so each channel counts as told.
        assert [heard.get(timeout=20), heard.get(timeout=20)] == [(QUEUED, ""), (DELIVERIES, "")]
        assert listener.listening
        with postgres.session() as session:
            tell(session, QUEUED, "jobs")
        assert heard.get(timeout=20) == (QUEUED, "jobs")
    assert not listener.listening


def test_what_is_committed_stays_so_where_the_notification_fails(
    postgres: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(notifications, "_SEND", sa.text("SELECT no_such_function(:channels, :payloads)"))
    with postgres.session() as session:
        session.add(lease("a"))
        tell(session, QUEUED, "jobs")
    with postgres.session() as session:
        assert session.get(Lease, "a") is not None


def test_listener_takes_one_connection_that_is_not_of_the_pool(postgres: Database) -> None:
    with hearing(postgres, QUEUED), postgres.session() as session:
        here = session.scalar(
            sa.text("SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND query LIKE 'LISTEN%'")
        )
        assert here == 1
        assert postgres.engine.pool.checkedout() == 1  # type: ignore[attr-defined]


def test_sqlite_has_no_notifications(sqlite_tables: Database) -> None:
    listener = Listener(sqlite_tables, (QUEUED,), lambda *_: pytest.fail("nothing can be heard"))
    listener.start()
    with sqlite_tables.session() as session:
        session.add(lease("a"))
        tell(session, QUEUED, "jobs")
    assert not listener.listening
    listener.stop()
