"""Stored files compared with rows: what no row names goes once it is safe, and what is missing is found and mended."""

from __future__ import annotations

import datetime
import json
import os
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_core.errors import NotFoundError
from specimap_infra import storage_check
from specimap_infra.backup import create_backup
from specimap_infra.database import Database
from specimap_infra.ids import new_id
from specimap_infra.migrate import migrate
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.storage_check import check_storage, repair_storage
from specimap_infra.tables import Artefact, Export, Job, StoredFile, Upload
from tests.support.backup_scene import place, specimap, stored
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def later(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two days later: whatever is stored is of a safe age."""
    now = datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=2)
    monkeypatch.setattr(storage_check, "utc_now", lambda: now)


def add_file(service: Running, result: Result, data: bytes = b"a photo", *, sha256: str | None = None) -> str:
    import hashlib

    name = new_id("file")
    key = f"acquisitions/{result.acquisition_id}/{name}"
    service.storage.put(key, data)
    with service.database.session() as session:
        session.add(
            StoredFile(
                id=name,
                acquisition_id=result.acquisition_id,
                role="photo",
                label=f"{name}.jpg",
                name="x",
                size=len(data),
                sha256=sha256 or hashlib.sha256(data).hexdigest(),
                storage_key=key,
                state="accepted",
                judgement={},
                created_by="k",
            )
        )
    return key


def add_remakeable(service: Running, result: Result) -> tuple[str, str]:
    """Rows of an artefact and an export without their files."""
    artefact, export = (
        f"acquisitions/{result.acquisition_id}/stages/{new_id('att')}.npz",
        f"exports/{new_id('exp')}/1/x.ply",
    )
    with service.database.session() as session:
        session.add(
            Artefact(
                id=new_id("att"),
                acquisition_id=result.acquisition_id,
                stage="render",
                key="k",
                storage_key=artefact,
                size=3,
                seconds=1.0,
            )
        )
        session.add(
            Export(
                id=export.split("/")[1],
                cloud_id=result.cloud_id,
                format="ply",
                state="succeeded",
                storage_key=export,
                size=3,
                correlation_id="",
                created_by="k",
            )
        )
    return artefact, export


def is_stored(storage: Storage, key: str) -> bool:
    try:
        return storage.stat(key).size >= 0
    except NotFoundError:
        return False


ORPHANS = (
    "acquisitions/acq_gone/file_gone",
    "jobs/job_gone/register/att_x/cloud.zarr/zarr.json",
    "clouds/c/labels/t/v1/x",
)


@pytest.mark.usefixtures("later")
def test_what_no_row_names_goes_and_nothing_else(service: Running, result: Result) -> None:
    add_file(service, result)
    before = stored(service.storage)
    assert check_storage(service.database, service.storage).clean
    for key in ORPHANS:
        service.storage.put(key, b"x")
    found = check_storage(service.database, service.storage)
    assert (sorted(item.key for item in found.orphans), found.missing) == (sorted(ORPHANS), [])
    done = repair_storage(service.database, service.storage, service.settings, found)
    assert sorted(done.removed) == sorted(ORPHANS)
    assert stored(service.storage) == before


def test_what_is_young_is_left_alone(service: Running, result: Result) -> None:
    service.storage.put(ORPHANS[0], b"x")
    path = service.storage.path(ORPHANS[0])
    assert path is not None
    # The time of its last write is that of the upload's last byte; it came into the storage just now.
    os.utime(path, (0, 0))
    found = check_storage(service.database, service.storage)
    assert (found.orphans, found.young, found.clean) == ([], 1, True)


@pytest.mark.usefixtures("later")
def test_strays_are_found_anywhere_and_moved_aside(service: Running, result: Result, tmp_path: Path) -> None:
    root = service.storage.folder
    assert root is not None
    whole = stored(service.storage)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "secret").write_bytes(b"x")
    strays = ["notes.txt", "old backup/a b.tar", "jobs/#1", "acquisitions/ä.raw", "exports/link", "exports/broken"]
    for key in strays[:4]:
        (root / key).parent.mkdir(parents=True, exist_ok=True)
        (root / key).write_bytes(key.encode())
    (root / "exports").mkdir(exist_ok=True)
    (root / "exports" / "link").symlink_to(elsewhere)
    (root / "exports" / "broken").symlink_to("nowhere")
    found = check_storage(service.database, service.storage)
    assert (sorted(item.key for item in found.strays), found.orphans, found.clean) == (sorted(strays), [], False)
    done = repair_storage(service.database, service.storage, service.settings, found)
    assert (sorted(done.moved), done.removed) == (sorted(strays), [])
    for key in strays[:4]:
        assert (root / done.moved[key]).read_bytes() == key.encode()
        assert not (root / key).exists()
    assert (elsewhere / "secret").read_bytes() == b"x"
    assert stored(service.storage) == whole
    # What was moved aside is left to a person.
    assert check_storage(service.database, service.storage).clean


@pytest.mark.usefixtures("later")
def test_places_and_results_behind_links_are_no_strays(service: Running, result: Result, tmp_path: Path) -> None:
    root = service.storage.folder
    assert root is not None
    for key in ("jobs", f"acquisitions/{result.acquisition_id}"):
        if not (root / key).exists():
            continue
        (tmp_path / "disk" / key).parent.mkdir(parents=True, exist_ok=True)
        (root / key).rename(tmp_path / "disk" / key)
        (root / key).symlink_to(tmp_path / "disk" / key)
    add_file(service, result)
    assert check_storage(service.database, service.storage).clean


@pytest.mark.usefixtures("later")
def test_parts_of_uploads_and_what_was_being_written_go_once_nothing_needs_them(
    service: Running, result: Result
) -> None:
    kept, gone = f"uploads/{new_id('up')}/0-a", [f"uploads/{new_id('up')}/0-b", "tmp/check-0"]
    now = datetime.datetime.now(datetime.UTC)
    with service.database.session() as session:
        session.add(
            Upload(
                id=kept.split("/")[1],
                acquisition_id=result.acquisition_id,
                role="photo",
                name="",
                size=9,
                state="open",
                created_by="k",
                created_at=now,
                expires_at=now,
            )
        )
    for key in (kept, *gone):
        service.storage.put(key, b"x")
    found = check_storage(service.database, service.storage)
    assert (sorted(item.key for item in found.orphans), found.strays, found.young) == (sorted(gone), [], 1)


@pytest.mark.usefixtures("later")
def test_what_is_being_published_is_left_alone_however_old(service: Running, result: Result) -> None:
    """A worker that waits for the database for days has stored its result, and its row comes afterwards."""
    with service.database.session() as session:
        session.execute(sa.update(Job).values(state="running"))
    keys = [
        f"jobs/{result.job_id}/register/att_new/report.json",
        f"acquisitions/{result.acquisition_id}/stages/att_new.npz",
    ]
    for key in keys:
        service.storage.put(key, b"x")
    found = check_storage(service.database, service.storage)
    assert (found.orphans, found.young) == ([], 2)


@pytest.mark.usefixtures("later")
def test_a_row_that_comes_after_the_check_keeps_its_file(service: Running, result: Result) -> None:
    key = add_file(service, result)
    with service.database.session() as session:
        row = session.scalars(sa.select(StoredFile)).one()
        values = {column.name: getattr(row, column.name) for column in StoredFile.__table__.columns}
        session.delete(row)
    found = check_storage(service.database, service.storage)
    assert [item.key for item in found.orphans] == [key]
    with service.database.session() as session:
        session.add(StoredFile(**values))
    assert repair_storage(service.database, service.storage, service.settings, found).removed == []
    assert is_stored(service.storage, key)


def test_what_is_missing_is_made_again_or_brought_back_or_named(
    service: Running, result: Result, tmp_path: Path
) -> None:
    photo, broken = add_file(service, result), add_file(service, result, b"another")
    create_backup(service.database, service.storage, tmp_path / "backup")
    whole = stored(service.storage)
    lost = add_file(service, result, b"after the backup")
    artefact, export = add_remakeable(service, result)
    for key in (photo, lost, f"{result.prefix}/cloud.zarr/xyz"):
        service.storage.delete(key)
    service.storage.put(broken, b"anothex")
    assert check_storage(service.database, service.storage).damaged == []
    found = check_storage(service.database, service.storage, checksums=True)
    assert {reference.key for reference in found.missing} == {photo, lost, result.prefix, artefact, export}
    assert [reference.key for reference in found.damaged] == [broken]
    done = repair_storage(service.database, service.storage, service.settings, found, backup=tmp_path / "backup")
    assert sorted(done.brought_back) == sorted([photo, broken, result.prefix])
    assert sorted(done.forgotten) == sorted([artefact, export])
    assert done.left == [lost]
    assert stored(service.storage) == whole
    with service.database.session() as session:
        assert session.scalar(sa.select(sa.func.count()).select_from(Artefact)) == 0
        assert session.scalar(sa.select(sa.func.count()).select_from(Export)) == 0
        assert session.scalar(sa.select(StoredFile.id).where(StoredFile.storage_key == lost)) is not None
    again = check_storage(service.database, service.storage, checksums=True)
    assert ([reference.key for reference in again.missing], again.damaged) == ([lost], [])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["local", "shared"])
def test_the_command_tells_and_mends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with place(kind, tmp_path / "data") as given:
        refused = specimap(given, "storage", "check")
        assert refused.returncode == 2, "there is no database"
        assert specimap(given, "keys", "list").returncode == 0
        clean = specimap(given, "storage", "check", "--json")
        assert (clean.returncode, json.loads(clean.stdout.splitlines()[-1])["orphans"]) == (0, [])
        storage = Storage.open(load_settings(**given))
        storage.put(ORPHANS[0], b"x")
        storage.put("notes", b"x")
        young = specimap(given, "storage", "check", "--repair", "--json")
        assert young.returncode == 0, young.stderr
        checked, repaired = (json.loads(line) for line in young.stdout.splitlines()[-2:])
        assert (checked["young"], checked["orphans"], repaired["removed"], repaired["moved"]) == (2, [], [], {})


@pytest.mark.slow
@pytest.mark.usefixtures("later")
def test_strays_in_a_bucket_are_moved_aside_within_the_prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with place("shared", tmp_path / "data") as given:
        settings = load_settings(**given)
        storage, database = Storage.open(settings), Database.open(settings.database)
        migrate(database)
        for key in ("notes", "old/a", ORPHANS[0]):
            storage.put(key, b"x")
        found = check_storage(database, storage)
        assert (sorted(item.key for item in found.strays), [item.key for item in found.orphans]) == (
            ["notes", "old/a"],
            [ORPHANS[0]],
        )
        done = repair_storage(database, storage, settings, found)
        assert (sorted(done.moved), done.removed) == (["notes", "old/a"], [ORPHANS[0]])
        assert storage.read(done.moved["old/a"]) == b"x"
        assert not is_stored(storage, "notes")
        assert check_storage(database, storage).clean
        database.close()
