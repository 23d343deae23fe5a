"""Rows and queues in a backup: every table returns, as it was at one moment, and counting goes on."""

from __future__ import annotations

import datetime
import gzip
import json
import threading
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command

from specimap_infra import jobs
from specimap_infra.backup import create_backup, restore_backup
from specimap_infra.backup.rows import LEFT_OUT, dump_rows
from specimap_infra.database import Database
from specimap_infra.migrate import migrate
from specimap_infra.queue import EXPORTS, MAKE_EXPORT
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    AuditEntry,
    Base,
    Export,
)
from tests.support.backup_scene import fake_capture
from tests.support.result_scene import put_result
from tests.support.service_scene import Running
from tests.support.worker_scene import Shop

# ---- rows ---------------------------------------------------------------------------------------------


def contents(database: Database) -> dict[str, list[dict[str, Any]]]:
    with database.engine.connect() as connection:
        return {
            name: sorted((dict(row) for row in connection.execute(sa.select(table)).mappings()), key=str)
            for name, table in Base.metadata.tables.items()
        }


def fill(database: Database) -> None:
    """Put a row into every table, whatever its columns."""
    with database.engine.begin() as connection:
        metadata = sa.MetaData()
        metadata.reflect(connection, only=lambda name, _: name in Base.metadata.tables)
        for table in metadata.sorted_tables:
            row: dict[str, Any] = {}
            for column in table.columns:
                (reference,) = column.foreign_keys or [None]
                if reference is not None:
                    row[column.name] = connection.scalar(sa.select(reference.column))
                elif isinstance(column.type, sa.JSON):
                    row[column.name] = {"of": [table.name, None, 0.1, "\u00e9"]}
                elif isinstance(column.type, sa.Boolean):
                    row[column.name] = True
                elif isinstance(column.type, sa.DateTime):
                    row[column.name] = datetime.datetime(2026, 11, 1, 10, 0, 0, 123456)
                elif isinstance(column.type, sa.Boolean):
                    row[column.name] = True
                elif isinstance(column.type, sa.Integer | sa.Float):
                    row[column.name] = 7
                elif not column.nullable:
                    row[column.name] = f"{table.name} '{column.name}'"
            if table.name in ("jobs", "exports"):
                row["state"] = "failed"
            connection.execute(table.insert(), [row])


@pytest.mark.parametrize("earlier", [True, False])
def test_rows_of_every_table_return_also_those_of_an_earlier_schema(
    any_database: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, earlier: bool
) -> None:
    old = load_settings(data_dir=tmp_path / "old", database_url=any_database)
    database, upgrade = Database.open(old.database), command.upgrade
    with monkeypatch.context() as patched:
        if earlier:
            patched.setattr(command, "upgrade", lambda config, _: upgrade(config, "0001"))
        migrate(database)
    fill(database)
    manifest = create_backup(database, Storage.open(old), tmp_path / "backup")
    assert (manifest.revision == "0001") == earlier
    with database.session() as session:
        # What a restore leaves out: rows whose file is missing and can be made again; leases; parts of open uploads;
        # sessions, and sign-ins under way.
        for table in ("artefacts", "leases", *(() if earlier else ("upload_parts", "sessions", "sign_in_attempts"))):
            session.execute(sa.text(f"DELETE FROM {table}"))
    target = load_settings(data_dir=tmp_path / "new")
    restore_backup(target, tmp_path / "backup")
    migrate(database)
    expected = contents(database)
    database.close()
    # The earlier schema's jobs were filled in without an idempotency key.
    empty = {"artefacts", "leases", "sessions", "sign_in_attempts", "upload_parts"}
    if earlier:
        empty |= {"audit_cursors", "dicom_instances", "dicom_sets", "erasures", "fhir_notices", "legal_holds", "people"}
        empty |= {"received_studies", "repeatable_requests", "shares", "studies"}
    assert {table for table, rows in expected.items() if not rows} == empty
    restored = Database.open(target.database)
    found = contents(restored)
    restored.close()
    if earlier:
        # The migration makes it, here and there.
        for (row,) in (found["projects"], expected["projects"]):
            del row["created_at"]
    assert found == expected


def test_numbers_and_queues_go_on_after_a_restore(
    restored_pair: tuple[Running, ServiceSettings], tmp_path: Path
) -> None:
    service, target = restored_pair
    result = put_result(service, tmp_path / "result")
    client = service.client()
    assert client.post(f"/v1/clouds/{result.cloud_id}/exports/ply").status_code == 202
    with service.database.session() as session:
        session.execute(sa.update(Export).values(state="running", executor="dead:0:executor"))
        last = session.scalar(sa.select(sa.func.max(AuditEntry.id)))
        export_id = session.scalar(sa.select(Export.id))
    assert last is not None
    create_backup(service.database, service.storage, tmp_path / "backup")
    restore_backup(target, tmp_path / "backup")
    restored = Database.open(target.database)
    with restored.session() as session:
        entry = AuditEntry(key_id="cli", project_id="p", action="a.b", target="t", details={}, correlation_id="")
        session.add(entry)
        session.flush()
        assert entry.id == last + 1
        export = session.get_one(Export, export_id)
        assert (export.state, export.executor) == ("queued", None)
        schema = "dbos." if restored.engine.dialect.name == "postgresql" else ""
        queued = session.execute(
            sa.text(f"SELECT workflow_uuid, name, queue_name, status FROM {schema}workflow_status")
        ).all()
    restored.close()
    assert [tuple(row) for row in queued] == [(export_id, MAKE_EXPORT, EXPORTS, "ENQUEUED")]


def test_rows_are_those_of_one_moment(tables: Database, tmp_path: Path) -> None:
    """A job and its event are written together, so no snapshot holds one without the other."""
    settings = load_settings(data_dir=tmp_path)
    stop, written_one = threading.Event(), threading.Event()
    yard = Shop(settings, {}, tables, Storage.open(settings), tmp_path)
    acquisition = yard.acquisition(*fake_capture(tmp_path / "capture"))

    def write() -> None:
        while not stop.is_set():
            job_id = yard.submit(acquisition)
            with tables.session() as session:
                jobs.request_cancel(session, job_id)
            written_one.set()

    writer = threading.Thread(target=write)
    writer.start()
    try:
        assert written_one.wait(60)
        for number in range(5):
            written = dump_rows(tables, tmp_path / f"rows-{number}", lambda: False).rows
            assert set(written) == Base.metadata.tables.keys() - LEFT_OUT
    finally:
        stop.set()
        writer.join()
    with gzip.open(tmp_path / "rows-4", "rt", encoding="utf-8") as file:
        rows = [json.loads(line) for line in file]
    ended = {row["id"] for table, row in rows if table == "jobs" and row["state"] == "cancelled"}
    assert ended
    assert ended == {row["job_id"] for table, row in rows if table == "job_events"}
