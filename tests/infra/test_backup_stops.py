"""Backups and restores that are stopped, and those that are refused."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_core.errors import CancelledError, OutputExistsError, SettingsError
from specimap_infra.backup import check_backup, create_backup, restore_backup
from specimap_infra.backup.manifest import FILES, LIST, MANIFEST, ROWS
from specimap_infra.backup.rows import dump_rows
from specimap_infra.database import Database
from specimap_infra.errors import BackupInvalidError, RestoreTargetError
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    Acquisition,
    CloudRow,
    StoredFile,
)
from tests.support.backup_scene import fake_capture, specimap, started, stored
from tests.support.databases import create_tables
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running
from tests.support.worker_scene import Shop, until

# ---- files --------------------------------------------------------------------------------------------


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


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
