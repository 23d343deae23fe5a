"""Backups made while the service works, and their restore on an empty machine."""

from __future__ import annotations

import datetime
import gzip
import json
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from alembic import command

from specimap_core.errors import CancelledError, OutputExistsError, SettingsError
from specimap_infra import jobs
from specimap_infra.backup import check_backup, create_backup, restore_backup
from specimap_infra.backup.manifest import FILES, LIST, MANIFEST, ROWS
from specimap_infra.backup.rows import dump_rows
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import BackupInvalidError, RestoreTargetError
from specimap_infra.ids import new_id
from specimap_infra.migrate import migrate
from specimap_infra.queue import EXPORTS, MAKE_EXPORT
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    Acquisition,
    Artefact,
    AuditEntry,
    Base,
    CloudRow,
    Export,
    Job,
    Lease,
    StoredFile,
    Upload,
)
from tests.support.backup_scene import answers, place, specimap, started, stored
from tests.support.databases import create_tables
from tests.support.result_scene import Result, put_label, put_result
from tests.support.service_scene import Running, serving
from tests.support.worker_scene import QUICK, Shop, shop, until


def add_artefact(database: Database, storage: Storage, acquisition_id: str, stage: str = "render") -> str:
    key = f"acquisitions/{acquisition_id}/stages/{new_id('att')}.npz"
    storage.put(key, b"an artefact")
    with database.session() as session:
        session.add(
            Artefact(
                id=new_id("att"),
                acquisition_id=acquisition_id,
                stage=stage,
                key=new_id("att"),
                storage_key=key,
                size=11,
                seconds=1.0,
            )
        )
    return key


def add_upload(database: Database, acquisition_id: str, state: str) -> str:
    upload_id = new_id("up")
    with database.session() as session:
        session.add(
            Upload(
                id=upload_id,
                acquisition_id=acquisition_id,
                role="photo",
                name="x.jpg",
                size=9,
                state=state,
                expires_at=utc_now(),
                created_by="key_test",
            )
        )
    return upload_id


def fake_capture(folder: Path) -> tuple[Path, Path]:
    """Files that stand in for photos and a cube; the quick stages read neither."""
    photos = folder / "photos"
    photos.mkdir(parents=True)
    for number in range(6):
        (photos / f"{number}.jpg").write_bytes(b"photo %d" % number)
    (folder / "scan.hdr").write_bytes(b"ENVI")
    (folder / "scan.raw").write_bytes(b"\0" * 64)
    return photos, folder / "scan.hdr"


# ---- an empty machine ---------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "other"), [("local", "local"), ("shared", "shared"), ("local", "shared")])
def test_the_service_goes_on_from_a_backup_on_an_empty_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, other: str
) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    backup, result_folder = tmp_path / "backup", tmp_path / "result"
    with place(kind, tmp_path / "old") as old, serving(tmp_path / "old", **old) as service:
        yard = Shop(service.settings, {}, service.database, service.storage, tmp_path)
        result = put_result(service, result_folder)
        put_label(service, result, "tissue", np.zeros(result.cloud.n_points, np.float32))
        client = service.client()
        secret = client.headers["Authorization"]
        before, files = answers(client, result.cloud_id), stored(service.storage)
        acquisition = yard.acquisition(*fake_capture(tmp_path / "capture"))
        waiting, running = yard.submit(acquisition), yard.submit(acquisition, priority=1)
        with service.database.session() as session:
            assert jobs.claim(session, running, "dead:0:executor") is not None
            session.add(Lease(executor="dead:0:executor", host="dead", kind="cpu", started=0, heartbeat=2e9))
        upload = add_upload(service.database, acquisition, "open")
        saved = specimap(old, "backup", "--to", str(backup), "--json")
        assert saved.returncode == 0, saved.stderr + saved.stdout
        assert json.loads(saved.stdout.splitlines()[-1])["event"] == "saved"
    with place(other, tmp_path / "new") as new:
        done = specimap(new, "restore", "--from", str(backup))
        assert done.returncode == 0, done.stderr
        with serving(tmp_path / "new", **new) as service:
            client = service.client()
            client.headers["Authorization"] = secret
            assert answers(client, result.cloud_id) == before
            found = stored(service.storage)
            assert {key: found[key] for key in files} == files
            assert client.get(f"/v1/jobs/{running}").json()["state"] == "queued"
            assert client.head(f"/v1/uploads/{upload}", headers={"Tus-Resumable": "1.0.0"}).status_code == 410
            with shop(tmp_path / "shop", **{**new, "scratch_dir": tmp_path / "scratch"}) as yard:
                assert yard.leases() == set()
                yard.start(QUICK, RESULT_FOLDER=str(result_folder))
                for job_id in (running, waiting):
                    assert yard.ended(job_id).state == "succeeded"
                    assert yard.storage.stat(f"{yard.cloud(job_id).prefix}/report.json").size > 100
        again = specimap(new, "restore", "--from", str(backup))
        assert again.returncode == 2
        assert "restore_target_not_empty" in again.stderr


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
                elif isinstance(column.type, sa.DateTime):
                    row[column.name] = datetime.datetime(2026, 11, 1, 10, 0, 0, 123456)
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
        # What a restore leaves out: rows whose file is missing and can be made again; leases; parts of open uploads.
        for table in ("artefacts", "leases") if earlier else ("artefacts", "leases", "upload_parts"):
            session.execute(sa.text(f"DELETE FROM {table}"))
    target = load_settings(data_dir=tmp_path / "new")
    restore_backup(target, tmp_path / "backup")
    migrate(database)
    expected = contents(database)
    database.close()
    # The earlier schema's jobs were filled in without an idempotency key.
    empty = {"artefacts", "leases", "upload_parts"} | ({"repeatable_requests"} if earlier else set())
    assert {table for table, rows in expected.items() if not rows} == empty
    restored = Database.open(target.database)
    found = contents(restored)
    restored.close()
    if earlier:
        # The migration makes it, here and there.
        for (row,) in (found["projects"], expected["projects"]):
            del row["created_at"]
    assert found == expected


@pytest.fixture
def restored_pair(any_database: str, tmp_path: Path) -> Iterator[tuple[Running, ServiceSettings]]:
    """A service on SQLite, and settings of an empty place on a database of each kind."""
    with serving(tmp_path / "old") as service:
        yield service, load_settings(data_dir=tmp_path / "new", database_url=any_database)


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
            assert set(written) == Base.metadata.tables.keys() - {"leases", "upload_parts"}
    finally:
        stop.set()
        writer.join()
    with gzip.open(tmp_path / "rows-4", "rt", encoding="utf-8") as file:
        rows = [json.loads(line) for line in file]
    ended = {row["id"] for table, row in rows if table == "jobs" and row["state"] == "cancelled"}
    assert ended
    assert ended == {row["job_id"] for table, row in rows if table == "job_events"}


# ---- files --------------------------------------------------------------------------------------------


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


def delete_job(service: Running, result: Result) -> None:
    """As the API does: the rows first, then the files."""
    with service.database.session() as session:
        session.execute(sa.delete(Job).where(Job.id == result.job_id))
    service.storage.delete(f"jobs/{result.job_id}")


def once(what: Callable[[], object]) -> Callable[..., None]:
    """Call it at the first call only."""
    left = [what]

    def call(*_: object) -> None:
        if left:
            left.pop()()

    return call


@pytest.mark.parametrize("row_first", [True, False])
def test_what_is_deleted_meanwhile_is_in_no_backup(
    service: Running, result: Result, tmp_path: Path, row_first: bool
) -> None:
    other = put_result(service, tmp_path / "other")
    add_artefact(service.database, service.storage, result.acquisition_id)
    # The artefact is copied first: then one of the results goes, whole or in part.
    victim = result if row_first else other

    def delete() -> None:
        if row_first:
            delete_job(service, victim)
        else:
            with service.database.session() as session:
                session.execute(sa.delete(Job).where(Job.id == victim.job_id))
            service.storage.delete(f"{victim.prefix}/cloud.zarr")

    manifest = create_backup(service.database, service.storage, tmp_path / "backup", progress=once(delete))
    assert (manifest.missing, manifest.damaged) == ([], [])
    assert manifest.rows["clouds"] == 1
    assert not (tmp_path / "backup" / FILES / victim.prefix).exists()
    restore_backup(load_settings(data_dir=tmp_path / "new"), tmp_path / "backup")
    kept = Storage.open(load_settings(data_dir=tmp_path / "new"))
    left = other if row_first else result
    assert kept.read(f"{left.prefix}/report.json") == (left.local / "report.json").read_bytes()


def test_what_is_missing_or_damaged_is_named_and_the_rest_is_saved(
    service: Running, result: Result, tmp_path: Path
) -> None:
    yard = Shop(service.settings, {}, service.database, service.storage, tmp_path)
    acquisition = yard.acquisition(*fake_capture(tmp_path / "capture"))
    lost = add_artefact(service.database, service.storage, acquisition)
    with service.database.session() as session:
        one, two, *_ = session.scalars(sa.select(StoredFile.storage_key).order_by(StoredFile.id)).all()
    service.storage.delete(lost)
    service.storage.delete(one)
    service.storage.put(two, b"photo X")
    manifest = create_backup(service.database, service.storage, tmp_path / "backup")
    assert (manifest.missing, manifest.damaged) == (sorted([lost, one]), [two])
    target = load_settings(data_dir=tmp_path / "new")
    restore_backup(target, tmp_path / "backup")
    restored = Database.open(target.database)
    with restored.session() as session:
        # An artefact can be made again; a photo cannot, and its row tells that it was there.
        assert session.scalar(sa.select(sa.func.count()).select_from(Artefact)) == 0
        assert session.scalar(sa.select(StoredFile.id).where(StoredFile.storage_key == one)) is not None
    restored.close()


def test_a_later_backup_links_what_an_earlier_one_holds(service: Running, result: Result, tmp_path: Path) -> None:
    create_backup(service.database, service.storage, tmp_path / "monday")
    put_result(service, tmp_path / "more")
    manifest = create_backup(service.database, service.storage, tmp_path / "tuesday", previous=tmp_path / "monday")
    name = Path(FILES) / result.prefix / "report.json"
    assert (tmp_path / "monday" / name).samefile(tmp_path / "tuesday" / name)
    assert manifest == check_backup(tmp_path / "tuesday")
    assert manifest.rows["clouds"] == 2


# ---- stops and refusals -------------------------------------------------------------------------------


def test_a_backup_that_is_stopped_leaves_nothing(service: Running, result: Result, tmp_path: Path) -> None:
    folder = tmp_path / "backups"
    stopped: list[float] = []
    with pytest.raises(CancelledError):
        create_backup(
            service.database,
            service.storage,
            folder / "one",
            progress=lambda _, share: stopped.append(share),
            cancelled=lambda: (folder.exists() and any(folder.rglob("spectra"))) or bool(stopped),
        )
    assert list(folder.iterdir()) == []
    create_backup(service.database, service.storage, folder / "one")
    with pytest.raises(OutputExistsError):
        create_backup(service.database, service.storage, folder / "one")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_stops_a_backup_in_the_middle_of_a_file(service: Running, tmp_path: Path, number: int) -> None:
    yard = Shop(service.settings, {}, service.database, service.storage, tmp_path)
    yard.acquisition(*fake_capture(tmp_path / "capture"))
    with service.database.session() as session:
        (key,) = session.scalars(sa.select(StoredFile.storage_key).where(StoredFile.label == "cube.raw")).all()
    large = service.storage.path(key)
    assert large is not None
    os.truncate(large, 8 * 1024**3)  # takes no space
    backups = tmp_path / "backups"
    backups.mkdir()
    with started({"data_dir": service.settings.data_dir}, "backup", "--to", str(backups / "one")) as program:
        until(lambda: any(path.stat().st_size > 1024**2 for path in backups.rglob("file_*")), 30, "the large file")
        program.send_signal(number)
        _, told = program.communicate(timeout=30)
    assert program.returncode == 130, told
    assert "cancelled" in told
    assert list(backups.iterdir()) == []


def test_a_restore_that_is_stopped_goes_on(restored_pair: tuple[Running, ServiceSettings], tmp_path: Path) -> None:
    service, target = restored_pair
    result = put_result(service, tmp_path / "result")
    create_backup(service.database, service.storage, tmp_path / "backup")
    shares: list[float] = []
    with pytest.raises(CancelledError):
        restore_backup(
            target,
            tmp_path / "backup",
            progress=lambda _, share: shares.append(share),
            cancelled=lambda: len(shares) >= 3,
        )
    storage = Storage.open(target)
    assert len(stored(storage)) == 3
    # What a disk did to one of them meanwhile.
    damaged = sorted(stored(storage))[0]
    path = storage.path(damaged)
    assert path is not None
    path.write_bytes(b"\0" * path.stat().st_size)
    restore_backup(target, tmp_path / "backup")
    assert stored(storage) == stored(service.storage)
    restored = Database.open(target.database)
    with restored.session() as session:
        assert session.get_one(CloudRow, result.cloud_id).prefix == result.prefix
    restored.close()


@pytest.mark.parametrize("part", [MANIFEST, ROWS, LIST, "a file", "a lost file"])
def test_a_backup_that_has_changed_is_refused_before_the_database_is_touched(
    service: Running, result: Result, tmp_path: Path, part: str
) -> None:
    backup = tmp_path / "backup"
    create_backup(service.database, service.storage, backup)
    path = backup / FILES / result.prefix / "report.json" if "file" in part.split() else backup / part
    if part == "a lost file":
        path.unlink()
    else:
        data = path.read_bytes()
        path.write_bytes(data[: len(data) // 2] + b"#" + data[len(data) // 2 + 1 :])
    target = load_settings(data_dir=tmp_path / "new")
    if part != MANIFEST:
        with pytest.raises(BackupInvalidError):
            check_backup(backup)
        with pytest.raises(BackupInvalidError):
            restore_backup(target, backup)
        assert not Path(target.database.removeprefix("sqlite:///")).exists()
        return
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(BackupInvalidError, match="not a whole backup"):
        restore_backup(target, backup)


@pytest.mark.parametrize("change", [{"format": 99}, {"revision": "9999"}])
def test_a_backup_of_a_newer_release_is_refused(service: Running, tmp_path: Path, change: dict[str, object]) -> None:
    create_backup(service.database, service.storage, tmp_path / "backup")
    manifest = tmp_path / "backup" / MANIFEST
    manifest.write_text(json.dumps({**json.loads(manifest.read_bytes()), **change, "program": "7.0"}), "utf-8")
    with pytest.raises(BackupInvalidError, match=r"release 7\.0"):
        restore_backup(load_settings(data_dir=tmp_path / "new"), tmp_path / "backup")


def test_a_restore_over_data_is_refused(restored_pair: tuple[Running, ServiceSettings], tmp_path: Path) -> None:
    service, target = restored_pair
    create_backup(service.database, service.storage, tmp_path / "backup")
    storage = Storage.open(target)
    storage.put("acquisitions/acq_x/file_x", b"a photo")
    with pytest.raises(RestoreTargetError, match="acquisitions/acq_x/file_x"):
        restore_backup(target, tmp_path / "backup")
    storage.delete("acquisitions/acq_x/file_x")
    used = Database.open(target.database)
    create_tables(used)
    with used.session() as session:
        session.add(
            Acquisition(
                id="acq_x",
                project_id="prj_00000000000000000000000000",
                specimen_id="S",
                dictionary="D",
                edge_mm=1,
                notes="",
                created_by="k",
            )
        )
    with pytest.raises(RestoreTargetError, match="acquisitions"):
        restore_backup(target, tmp_path / "backup")
    with used.session() as session:
        session.execute(sa.delete(Acquisition))
    used.close()
    # Tables without rows, as after `specimap keys list`, are no data.
    restore_backup(target, tmp_path / "backup")


@pytest.mark.slow
def test_a_folder_without_a_service_is_not_saved(tmp_path: Path) -> None:
    done = specimap({"data_dir": tmp_path / "wrong"}, "backup", "--to", str(tmp_path / "backup"))
    assert done.returncode == 2
    assert "SPECIMAP_DATA_DIR" in done.stderr
    assert list(tmp_path.iterdir()) == []
    empty = Database.open(f"sqlite:///{tmp_path / 'empty.db'}")
    with pytest.raises(SettingsError):
        dump_rows(empty, tmp_path / "rows", lambda: False)
    empty.close()
