"""The chain of the audit trail: sealed by several at once, kept by triggers, and every tampering found."""

from __future__ import annotations

import datetime
import threading
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command

from specimap_infra.audit.pruning import prune
from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.sealing import BATCH, seal
from specimap_infra.audit.triggers import drop_triggers
from specimap_infra.audit.verification import Anchor, chain_head, verify
from specimap_infra.backup import create_backup, restore_backup
from specimap_infra.database import Database, utc_now
from specimap_infra.migrate import alembic_config, migrate
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import AuditCursor, AuditEntry, AuditHead
from tests.support.databases import sqlalchemy_url

PLAIN = ChainKeys()
KEYED = ChainKeys(b"k" * 32)


def add(database: Database, count: int, at: datetime.datetime | None = None) -> None:
    with database.session() as session:
        session.add_all(
            AuditEntry(
                at=at or utc_now(),
                key_id="k",
                project_id="p",
                action="a.b",
                target=f"t{number}",
                details={"n": number, "share": 0.1, "text": "é"},
                correlation_id="c",
            )
            for number in range(count)
        )


def head(database: Database) -> Anchor:
    with database.session() as session:
        return chain_head(session)


def tamper(database: Database, *statements: str) -> None:
    """What somebody does who may do everything in the database."""
    with database.engine.begin() as connection:
        drop_triggers(connection)
        for statement in statements:
            connection.exec_driver_sql(statement)


def found(database: Database, keys: ChainKeys = PLAIN, anchor: Anchor | None = None) -> tuple[str, int] | None:
    fault = verify(database, keys, anchor).fault
    return None if fault is None else (fault.kind, fault.seq)


@pytest.mark.parametrize("keys", [PLAIN, KEYED], ids=["plain", "keyed"])
def test_entries_are_chained_in_order_and_verify(tables: Database, keys: ChainKeys) -> None:
    add(tables, BATCH + 3)
    assert seal(tables, keys) == BATCH + 3
    assert seal(tables, keys) == 0
    add(tables, 2)
    verified = verify(tables, keys)
    assert (verified.records, verified.first, verified.last, verified.unsealed) == (BATCH + 3, 1, BATCH + 3, 2)
    assert verified.fault is None
    with tables.session() as session:
        rows = session.execute(
            sa.select(AuditEntry.id, AuditEntry.hash).order_by(AuditEntry.seq.asc().nulls_last())
        ).all()
    assert [row.id for row in rows] == sorted(row.id for row in rows)
    assert head(tables).hash == rows[BATCH + 2].hash
    assert str(rows[0].hash).startswith("hmac-sha256:" if keys is KEYED else "sha256:")


def test_writers_and_sealers_of_several_programs_make_one_chain(tables: Database) -> None:
    stop, faults = threading.Event(), list[BaseException]()

    def guarded(work: Any) -> threading.Thread:
        def run() -> None:
            try:
                work()
            except BaseException as error:
                faults.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        return thread

    def sealing() -> None:
        while not stop.is_set():
            seal(tables, PLAIN)
            stop.wait(0.005)

    sealers = [guarded(sealing) for _ in range(3)]

    def writing() -> None:
        for _ in range(20):
            add(tables, 5)

    writers = [guarded(writing) for _ in range(3)]
    for thread in writers:
        thread.join(60)
    stop.set()
    for thread in sealers:
        thread.join(60)
    seal(tables, PLAIN)
    assert faults == []
    verified = verify(tables, PLAIN)
    assert (verified.records, verified.last, verified.unsealed, verified.fault) == (300, 300, 0, None)


@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE audit SET action = 'x' WHERE seq = 2",
        "UPDATE audit SET hash = 'x' WHERE seq = 2",
        "UPDATE audit SET seq = NULL WHERE seq = 2",
        "UPDATE audit SET details = '{}' WHERE seq IS NULL",
        "UPDATE audit SET seq = 99, hash = 'h', previous_hash = 'p', key_id = 'x' WHERE seq IS NULL",
        "DELETE FROM audit WHERE seq = 1",
        "DELETE FROM audit WHERE seq IS NULL",
        "DELETE FROM audit",
    ],
)
def test_the_database_refuses_changes_of_entries(tables: Database, statement: str) -> None:
    add(tables, 3)
    seal(tables, PLAIN)
    add(tables, 1)
    with pytest.raises(sa.exc.DBAPIError, match="append-only"), tables.engine.begin() as connection:
        connection.exec_driver_sql(statement)
    if tables.engine.dialect.name == "postgresql":
        with pytest.raises(sa.exc.DBAPIError, match="append-only"), tables.engine.begin() as connection:
            connection.exec_driver_sql("TRUNCATE audit")
    assert verify(tables, PLAIN).records == 3


SWAP = (
    "UPDATE audit SET seq = -1 WHERE seq = 3",
    "UPDATE audit SET seq = 3 WHERE seq = 4",
    "UPDATE audit SET seq = 4 WHERE seq = -1",
)


@pytest.mark.parametrize(
    ("statements", "fault"),
    [
        (("UPDATE audit SET key_id = 'other' WHERE seq = 3",), ("changed", 3)),
        (("UPDATE audit SET at = '2020-01-01 00:00:00' WHERE seq = 3",), ("changed", 3)),
        (("UPDATE audit SET details = '{\"n\": 9}' WHERE seq = 5",), ("changed", 5)),
        (("DELETE FROM audit WHERE seq = 3",), ("missing", 3)),
        (("DELETE FROM audit WHERE seq <= 2",), ("missing", 1)),
        (("DELETE FROM audit WHERE seq >= 5",), ("missing", 5)),
        (
            (
                "DELETE FROM audit WHERE seq = 3",
                "UPDATE audit SET seq = 3 WHERE seq = 4",
                "UPDATE audit SET seq = 4 WHERE seq = 5",
            ),
            ("missing", 3),
        ),
        (SWAP, ("reordered", 3)),
        (("DELETE FROM audit WHERE seq <= 2", "UPDATE audit_head SET pruned_seq = 2"), ("changed", 2)),
    ],
)
@pytest.mark.parametrize("keys", [PLAIN, KEYED], ids=["plain", "keyed"])
def test_tampering_is_found_with_its_place_and_kind(
    tables: Database, statements: tuple[str, ...], fault: tuple[str, int], keys: ChainKeys
) -> None:
    add(tables, 5)
    seal(tables, keys)
    tamper(tables, *statements)
    assert found(tables, keys) == fault


def test_a_record_changed_with_its_hash_is_found_by_the_next_one_or_by_the_key(tables: Database) -> None:
    add(tables, 5)
    seal(tables, PLAIN)
    tamper(tables, "UPDATE audit SET key_id = 'other', hash = 'sha256:00' WHERE seq = 3")
    assert found(tables) == ("changed", 3)
    with tables.session() as session:
        # All after it made anew, as somebody can who knows the program but not the key.
        session.execute(sa.update(AuditEntry).where(AuditEntry.seq >= 3).values(seq=None))
        session.execute(
            sa.update(AuditHead).values(
                seq=2, hash=sa.select(AuditEntry.hash).where(AuditEntry.seq == 2).scalar_subquery()
            )
        )
    before = Anchor(5, head(tables).hash)
    seal(tables, PLAIN)
    assert found(tables) is None
    assert found(tables, PLAIN, before) == ("changed", 5)
    assert found(tables, KEYED) == ("changed", 5)


def test_an_anchor_finds_a_cut_end(tables: Database) -> None:
    add(tables, 5)
    seal(tables, KEYED)
    anchor = head(tables)
    assert verify(tables, KEYED, anchor).anchored is True
    with tables.session() as session:
        earlier = session.scalars(sa.select(AuditEntry.hash).where(AuditEntry.seq == 3)).one()
    tamper(tables, "DELETE FROM audit WHERE seq > 3", f"UPDATE audit_head SET seq = 3, hash = '{earlier}'")
    assert found(tables, KEYED) is None
    assert found(tables, KEYED, anchor) == ("missing", 4)
    assert Anchor.parsed(str(anchor)) == anchor


def test_a_chain_goes_on_with_another_key_and_says_when_one_is_missing(tables: Database) -> None:
    add(tables, 2)
    seal(tables, PLAIN)
    add(tables, 2)
    seal(tables, KEYED)
    add(tables, 2)
    newer = ChainKeys(b"n" * 32, (b"k" * 32,))
    seal(tables, newer)
    assert found(tables, newer) is None
    assert found(tables, ChainKeys(b"n" * 32)) == ("unknown_key", 3)
    add(tables, 1)
    seal(tables, PLAIN)
    assert found(tables, newer) == ("changed", 7)


def test_what_retention_leaves_can_be_verified(tables: Database) -> None:
    old = utc_now() - datetime.timedelta(days=10)
    add(tables, 4, old)
    seal(tables, KEYED)
    anchor = head(tables)
    add(tables, 3)
    before = utc_now() - datetime.timedelta(days=5)
    assert prune(tables, KEYED, before, "tls://log:6514") == 0
    with tables.session() as session:
        session.add(AuditCursor(destination="tls://log:6514", seq=2))
    assert prune(tables, KEYED, before, "tls://log:6514") == 2
    assert prune(tables, KEYED, before) == 2
    assert prune(tables, KEYED, before) == 0
    seal(tables, KEYED)
    verified = verify(tables, KEYED, anchor)
    assert (verified.first, verified.last, verified.fault, verified.anchored) == (5, 9, None, True)
    with tables.session() as session:
        told = session.scalars(sa.select(AuditEntry.details).where(AuditEntry.action == "audit.prune")).all()
    assert told[-1] == {"through": 4, "hash": anchor.hash, "entries": 2}
    # Somebody who takes more away, and says so in the head.
    with tables.session() as session:
        sixth = session.scalars(sa.select(AuditEntry.hash).where(AuditEntry.seq == 6)).one()
    tamper(tables, "DELETE FROM audit WHERE seq <= 6", f"UPDATE audit_head SET pruned_seq = 6, pruned_hash = '{sixth}'")
    assert found(tables, KEYED) == ("missing", 6)


def test_entries_of_a_release_before_are_chained_after_the_upgrade(
    any_database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    database, upgrade = Database.open(sqlalchemy_url(any_database)), command.upgrade
    with monkeypatch.context() as patched:
        patched.setattr(command, "upgrade", lambda config, _: upgrade(config, "0009"))
        migrate(database)
    names = "id, at, key_id, project_id, action, target, details, correlation_id"
    with database.engine.begin() as connection:
        for number in (3, 8):
            values = f"{number}, '2026-11-01 10:00:00', 'key_1', 'p', 'job.create', 'job_1', '{{}}', 'c'"
            connection.exec_driver_sql(f"INSERT INTO audit ({names}) VALUES ({values})")
    migrate(database)
    assert seal(database, PLAIN) == 2
    verified = verify(database, PLAIN)
    assert (verified.records, verified.fault) == (2, None)
    with database.engine.connect() as connection:
        assert alembic_config(connection).attributes["connection"] is connection
    with pytest.raises(sa.exc.DBAPIError, match="append-only"), database.engine.begin() as connection:
        connection.exec_driver_sql("DELETE FROM audit")
    database.close()


def test_a_restored_chain_verifies_and_goes_on(any_database: str, tmp_path: Path) -> None:
    old = load_settings(data_dir=tmp_path / "old")
    database = Database.open(old.database)
    migrate(database)
    add(database, 4, utc_now() - datetime.timedelta(days=10))
    seal(database, KEYED)
    prune(database, KEYED, utc_now() - datetime.timedelta(days=5))
    add(database, 3)
    seal(database, KEYED)
    anchor = head(database)
    create_backup(database, Storage.open(old), tmp_path / "backup")
    database.close()
    new = load_settings(data_dir=tmp_path / "new", database_url=any_database)
    restore_backup(new, tmp_path / "backup")
    restored = Database.open(new.database)
    add(restored, 2)
    seal(restored, KEYED)
    verified = verify(restored, KEYED, anchor)
    assert (verified.first, verified.last, verified.fault, verified.anchored) == (5, 10, None, True)
    with pytest.raises(sa.exc.DBAPIError, match="append-only"), restored.engine.begin() as connection:
        connection.exec_driver_sql("DELETE FROM audit")
    restored.close()
