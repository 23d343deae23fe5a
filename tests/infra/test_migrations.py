"""Upgrades of a database that holds data, on both kinds."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from specimap_infra.database import Database
from specimap_infra.migrate import alembic_config, migrate, whole
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.tables import Base
from tests.support.databases import sqlalchemy_url

NOW = "2026-11-01 10:00:00"
KEYS = {
    "tablet": ["upload", "read"],
    "viewer": ["read"],
    "classifier": ["read", "label"],
    "head": ["upload", "read", "label", "admin"],
}
ROWS: dict[str, dict[str, Any]] = {
    "acquisitions": {"id": "acq_1", "specimen_id": "S", "dictionary": "D", "edge_mm": 6.8, "notes": "a 'quote'"},
    "files": {
        "id": "file_1",
        "acquisition_id": "acq_1",
        "role": "photo",
        "label": "photo-0001.jpg",
        "name": "x",
        "size": 2**40,
        "sha256": "0",
        "storage_key": "k",
        "state": "accepted",
        "judgement": "{}",
    },
    "uploads": {
        "id": "up_1",
        "acquisition_id": "acq_1",
        "role": "photo",
        "name": "x",
        "size": 3,
        "state": "open",
        "expires_at": NOW,
    },
    "jobs": {
        "id": "job_1",
        "acquisition_id": "acq_1",
        "settings": "{}",
        "priority": 1,
        "state": "succeeded",
        "progress": 1.0,
        "starts": 1,
        "request_hash": "h",
        "correlation_id": "c",
        "seconds": "{}",
        "idempotency_key": "once",
    },
    "job_events": {"job_id": "job_1", "seq": 1, "type": "state", "data": "{}", "at": NOW},
    "artefacts": {
        "id": "art_1",
        "acquisition_id": "acq_1",
        "stage": "render",
        "key": "k",
        "storage_key": "s",
        "size": 1,
        "seconds": 0.5,
    },
    "clouds": {
        "id": "cloud_1",
        "job_id": "job_1",
        "acquisition_id": "acq_1",
        "prefix": "p",
        "points": 1,
        "bands": 2,
        "size": 3,
        "report": "{}",
    },
    "labels": {
        "cloud_id": "cloud_1",
        "name": "tissue",
        "version": 1,
        "kind": "class",
        "classes": "[]",
        "made_by": "{}",
        "storage_prefix": "p",
        "sha256": "0",
    },
    "exports": {
        "id": "exp_1",
        "cloud_id": "cloud_1",
        "format": "ply",
        "state": "succeeded",
        "labels_hash": "",
        "correlation_id": "c",
    },
    "deliveries": {"id": "dlv_1", "job_id": "job_1", "state": "pending", "attempts": 2, "next_at": NOW},
    "audit": {
        "id": 41,
        "at": NOW,
        "key_id": "key_tablet",
        "action": "job.create",
        "target": "job_1",
        "details": "{}",
        "correlation_id": "c",
    },
}


@pytest.fixture
def first(any_database: str, monkeypatch: pytest.MonkeyPatch) -> Database:
    """A database of the first version, with a row in every table, made as that version made it."""
    database = Database.open(sqlalchemy_url(any_database))
    upgrade = command.upgrade
    with monkeypatch.context() as patched:
        patched.setattr(command, "upgrade", lambda config, _: upgrade(config, "0001"))
        migrate(database)
    with database.engine.begin() as connection:
        for name, scopes in KEYS.items():
            _insert(
                connection,
                "api_keys",
                {
                    "id": f"key_{name}",
                    "name": name,
                    "secret_hash": "h",
                    "scopes": json.dumps(scopes),
                    "created_at": NOW,
                },
            )
        for table, row in ROWS.items():
            columns = {column["name"] for column in sa.inspect(connection).get_columns(table)}
            made = {"created_at": NOW, "created_by": "key_tablet"}
            _insert(connection, table, {**{k: v for k, v in made.items() if k in columns}, **row})
    return database


def _insert(connection: sa.Connection, table: str, row: dict[str, Any]) -> None:
    names = ", ".join(f'"{name}"' for name in row)
    values = ", ".join(f":{name}" for name in row)
    connection.execute(sa.text(f"INSERT INTO {table} ({names}) VALUES ({values})"), row)


def _contents(database: Database) -> dict[str, list[dict[str, Any]]]:
    with database.engine.connect() as connection:
        return {
            table: [dict(row) for row in connection.execute(sa.text(f"SELECT * FROM {table}")).mappings()]
            for table in ("api_keys", *ROWS)
        }


def test_data_of_the_first_version_come_into_the_default_project(first: Database) -> None:
    before = _contents(first)
    assert all(before.values())
    migrate(first)
    after = _contents(first)
    for table, rows in before.items():
        # Later versions only add columns.
        kept = [{name: row[name] for name in rows[0]} for row in after[table]]
        if table == "api_keys":
            rows, kept = ([{k: v for k, v in row.items() if k != "scopes"} for row in part] for part in (rows, kept))
        assert sorted(kept, key=str) == sorted(rows, key=str), table
    for table in ("api_keys", "acquisitions", "audit"):
        assert {row["project_id"] for row in after[table]} == {DEFAULT_PROJECT}
    with first.session() as session:
        scopes = {row.name: row.scopes for row in session.execute(sa.text("SELECT name, scopes FROM api_keys"))}
        projects = session.execute(sa.text("SELECT id, name FROM projects")).all()
    found = {name: json.loads(value) if isinstance(value, str) else value for name, value in scopes.items()}
    assert found == {**KEYS, "tablet": ["upload", "read", "intraoperative"]}
    assert [tuple(row) for row in projects] == [(DEFAULT_PROJECT, "default")]
    # Twice is once.
    migrate(first)
    assert _contents(first) == after
    first.close()


def test_idempotency_keys_of_jobs_go_on_working(first: Database) -> None:
    migrate(first)
    with first.session() as session:
        rows = session.execute(sa.text("SELECT key_id, name, request_hash, object_id FROM repeatable_requests")).all()
    assert [tuple(row) for row in rows] == [("key_tablet", "once", "h", "job_1")]
    first.close()


def test_schema_is_that_of_the_tables(first: Database) -> None:
    migrate(first)
    with first.engine.connect() as connection:
        # The tables of the job engine are in the same database.
        context = MigrationContext.configure(
            connection,
            opts={"include_object": lambda _, name, kind, *__: kind != "table" or name in Base.metadata.tables},
        )
        assert compare_metadata(context, Base.metadata) == []
    first.close()


def test_references_hold_afterwards(first: Database) -> None:
    migrate(first)
    with pytest.raises(sa.exc.IntegrityError), first.session() as session:
        session.execute(sa.text("UPDATE acquisitions SET project_id = 'prj_x'"))
    with pytest.raises(sa.exc.IntegrityError), first.session() as session:
        session.execute(sa.text("UPDATE api_keys SET project_id = NULL"))
    with first.session() as session:
        session.execute(sa.text("DELETE FROM acquisitions"))
    left = _contents(first)
    assert {table for table, rows in left.items() if rows} == {"api_keys", "audit"}
    first.close()


def test_a_migration_that_fails_changes_nothing(first: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    before = _contents(first)

    def fail(upgrade: Callable[..., None]) -> Callable[..., None]:
        def failing(config: Any, revision: str) -> None:
            upgrade(config, revision)
            raise RuntimeError("the machine goes down")

        return failing

    with monkeypatch.context() as patched:
        patched.setattr(command, "upgrade", fail(command.upgrade))
        with pytest.raises(RuntimeError, match="goes down"):
            migrate(first)
    assert _contents(first) == before
    migrate(first)
    assert _contents(first)["acquisitions"][0]["project_id"] == DEFAULT_PROJECT
    first.close()


def test_downgrade_gives_the_first_version_back(first: Database) -> None:
    before = _contents(first)
    migrate(first)
    with first.engine.connect() as connection, whole(connection):
        command.downgrade(alembic_config(connection), "0001")
    assert _contents(first) == before
    first.close()
