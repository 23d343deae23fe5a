"""A data folder of an earlier release, brought to this one by the command that an administrator gives."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from alembic import command

from specimap_infra.database import Database, utc_now
from specimap_infra.migrate import alembic_config, whole
from specimap_infra.schema_version import known_revisions, revision_of
from specimap_infra.settings import load_settings
from specimap_infra.tables import Base
from tests.support.backup_scene import add_artefact, add_upload, answers, fake_capture, place, specimap, stored
from tests.support.result_scene import put_label, put_result
from tests.support.service_scene import serving
from tests.support.worker_scene import Shop

EARLIER = ("0007", "0009")
"""Schemas of earlier releases: before sessions and shares, and with them."""
SOON = (utc_now() + datetime.timedelta(days=7)).isoformat()


def rows(database: Database) -> dict[str, list[dict[str, Any]]]:
    """Every row of our tables, by table, with the columns that the database has."""
    found: dict[str, list[dict[str, Any]]] = {}
    with database.engine.connect() as connection:
        metadata = sa.MetaData()
        metadata.reflect(connection)
        for name, table in metadata.tables.items():
            if name in Base.metadata.tables:
                found[name] = [dict(row) for row in connection.execute(sa.select(table)).mappings()]
    return found


def turn_back(settings: dict[str, Any], revision: str) -> dict[str, list[dict[str, Any]]]:
    """Give a database the schema of an earlier release, with its rows; gives these."""
    database = Database.open(load_settings(**settings).database)
    with database.engine.connect() as connection, whole(connection):
        command.downgrade(alembic_config(connection), revision)
    with database.engine.connect() as connection:
        assert revision_of(connection) == revision
    before = rows(database)
    database.close()
    return before


@pytest.mark.slow
@pytest.mark.waits
@pytest.mark.parametrize("revision", EARLIER)
@pytest.mark.parametrize("kind", ["local", "shared"])
def test_a_service_goes_on_with_the_data_of_an_earlier_release(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, revision: str
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with place(kind, tmp_path / "data") as settings:
        with serving(tmp_path / "data", **settings) as service:
            yard = Shop(service.settings, {}, service.database, service.storage, tmp_path)
            result = put_result(service, tmp_path / "result")
            put_label(service, result, "tissue", np.zeros(result.cloud.n_points, np.float32))
            acquisition = yard.acquisition(*fake_capture(tmp_path / "capture"))
            add_artefact(service.database, service.storage, acquisition)
            add_upload(service.database, acquisition, "open")
            waiting = yard.submit(acquisition)
            client = service.client()
            secret = client.headers["Authorization"]
            made = client.post("/v1/keys", json={"name": "tablet 3", "scopes": ["read"]})
            assert made.status_code == 201
            seen, files = answers(client, result.cloud_id), stored(service.storage)
        before = turn_back(settings, revision)
        assert len(before["files"]) > 5
        assert before["audit"]

        done = specimap(settings, "migrate")
        assert done.returncode == 0, done.stderr
        assert done.stdout.strip() == f"The database has schema {known_revisions()[0]}."
        database = Database.open(load_settings(**settings).database)
        after = rows(database)
        database.close()
        for table, old in before.items():
            # A later release adds columns and tables, and takes nothing away.
            kept = [{name: row[name] for name in old[0]} for row in after[table]] if old else after[table]
            assert sorted(kept, key=str) == sorted(old, key=str), table

        with serving(tmp_path / "data", **settings) as service:
            client = service.client()
            client.headers["Authorization"] = secret
            assert answers(client, result.cloud_id) == seen
            assert stored(service.storage) == files
            assert client.get(f"/v1/jobs/{waiting}").json()["state"] == "queued"
            actions = [entry["action"] for entry in client.get("/v1/audit").json()["items"]]
            assert "key.create" in actions
            # What is new in this release works on what is old.
            shared = client.post(f"/v1/clouds/{result.cloud_id}/shares", json={"name": "board", "expires_at": SOON})
            assert shared.status_code == 201, shared.text


def test_the_command_makes_a_database_and_does_nothing_the_second_time(tmp_path: Path) -> None:
    for _ in range(2):
        done = specimap({"data_dir": tmp_path / "data"}, "migrate")
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "data" / "specimap.db").stat().st_mode & 0o077 == 0


def test_the_command_says_what_is_wrong(tmp_path: Path) -> None:
    (tmp_path / "specimap.db").write_bytes(b"no database " * 100)
    done = specimap({"data_dir": tmp_path}, "migrate")
    assert done.returncode == 2
    assert "database_damaged" in done.stderr
