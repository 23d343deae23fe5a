"""Backups made while the service works: a restore on an empty machine, and files that go meanwhile."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.backup import check_backup, create_backup, restore_backup
from specimap_infra.backup.manifest import FILES
from specimap_infra.database import Database
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    Artefact,
    Job,
    Lease,
    StoredFile,
)
from tests.support.backup_scene import add_artefact, add_upload, answers, fake_capture, place, specimap, stored
from tests.support.result_scene import Result, put_label, put_result
from tests.support.service_scene import Running, serving
from tests.support.worker_scene import QUICK, Shop, shop

# ---- an empty machine ---------------------------------------------------------------------------------


@pytest.mark.waits
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
