"""Rules of retention and legal holds: what goes by itself, and what nobody may delete."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa

from specimap_infra.database import Database, utc_now
from specimap_infra.housekeeping import Housekeeping
from specimap_infra.queue import queue_client
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import Acquisition, AuditEntry, Job, LegalHold, StoredFile
from tests.support.job_scene import acquisition, queued_job
from tests.support.result_scene import put_label, put_result
from tests.support.service_scene import Running

OLD = utc_now() - datetime.timedelta(days=100)


def age(database: Database, acquisition_id: str, *, job: datetime.datetime | None = OLD) -> None:
    with database.session() as session:
        session.execute(sa.update(Acquisition).where(Acquisition.id == acquisition_id).values(created_at=OLD))
        session.execute(sa.update(StoredFile).where(StoredFile.acquisition_id == acquisition_id).values(created_at=OLD))
        if job is not None:
            done = {"created_at": job, "finished_at": job, "state": "succeeded"}
            session.execute(sa.update(Job).where(Job.acquisition_id == acquisition_id).values(**done))


def swept(database: Database, storage: Storage, **keep: Any) -> int:
    assert storage.folder is not None
    settings = load_settings(data_dir=storage.folder.parent, **keep)
    return Housekeeping(database, storage, settings, queue_client(database.engine)).sweep()["acquisitions"]


def left(database: Database) -> set[str]:
    with database.session() as session:
        return set(session.scalars(sa.select(Acquisition.id)))


@pytest.fixture
def store(tmp_path: Path) -> Storage:
    return Storage.open(load_settings(data_dir=tmp_path / "data"))


def test_acquisitions_go_after_their_last_job(tables: Database, store: Storage) -> None:
    old, worked, young, busy, held = (acquisition(tables) for _ in range(5))
    for name in (old, worked, busy, held):
        age(tables, name)
    queued_job(tables, old)
    age(tables, old)
    queued_job(tables, worked)
    age(tables, worked, job=utc_now())
    queued_job(tables, busy)
    with tables.session() as session:
        session.add(LegalHold(acquisition_id=held, reason="lawsuit", created_by="key_1"))
    key = f"acquisitions/{old}/file"
    store.put(key, b"x")
    assert swept(tables, store) == 0
    assert swept(tables, store, keep_acquisition_days=200) == 0
    assert swept(tables, store, keep_acquisition_days=30) == 1
    assert left(tables) == {worked, young, busy, held}
    path = store.path(key)
    assert path is not None
    assert not path.exists()
    with tables.session() as session:
        told = session.execute(
            sa.select(AuditEntry.key_id, AuditEntry.target).where(AuditEntry.action == "acquisition.expire")
        ).all()
    assert [tuple(row) for row in told] == [("service", old)]


def test_rules_of_projects_win(tables: Database, store: Storage) -> None:
    from specimap_infra.projects import new_project

    with tables.session() as session:
        study = new_project(session, "study").id
    mine, theirs = acquisition(tables, project=study), acquisition(tables)
    for name in (mine, theirs):
        age(tables, name)
    assert swept(tables, store, keep_acquisition_days=30, keep_acquisition_days_of={"study": 0}) == 1
    assert left(tables) == {mine}
    assert swept(tables, store, keep_acquisition_days_of={study: 200}) == 0
    assert swept(tables, store, keep_acquisition_days_of={"study": 30}) == 1
    assert left(tables) == set()


def test_labelled_acquisitions_stay_unless_the_settings_say_otherwise(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    put_label(service, result, "tissue", np.zeros(result.cloud.n_points, np.uint8))
    age(service.database, result.acquisition_id)
    assert swept(service.database, service.storage, keep_acquisition_days=30) == 0
    assert swept(service.database, service.storage, keep_acquisition_days=30, keep_labelled=False) == 1
    assert list(service.storage.list("jobs")) == []


def test_the_database_itself_keeps_what_is_held(tables: Database) -> None:
    held = acquisition(tables)
    with tables.session() as session:
        session.add(LegalHold(acquisition_id=held, reason="lawsuit", created_by="key_1"))
    with pytest.raises(sa.exc.IntegrityError), tables.session() as session:
        session.execute(sa.delete(Acquisition).where(Acquisition.id == held))
    assert left(tables) == {held}
