"""What grows is removed by its rule, and nothing else is."""

from __future__ import annotations

import datetime
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
import sqlalchemy as sa

from specimap_core.errors import NotFoundError, SpecimapError
from specimap_infra import housekeeping, jobs
from specimap_infra.database import Database, utc_now
from specimap_infra.housekeeping import Housekeeping, count_rows
from specimap_infra.ids import new_id
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.queue import JOBS, RUN_JOB, enqueue, queue_client
from specimap_infra.schema_version import engine_schema
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    Artefact,
    AuditEntry,
    Delivery,
    Export,
    Job,
    JobEvent,
    LabelVersion,
    RepeatableRequest,
    SignIn,
    Upload,
)
from specimap_service.auth.keys import new_key
from tests.support.job_scene import EXECUTOR, acquisition, queued_job
from tests.support.result_scene import put_label, put_result
from tests.support.service_scene import Running
from tests.support.worker_scene import QUICK, shop, until

OLD = utc_now() - datetime.timedelta(days=4000)
NEVER: dict[str, Any] = {
    f"keep_{name}": 0
    for name in (
        *("event_days", "workflow_days", "artefact_days", "export_days"),
        *("upload_days", "delivery_days", "audit_days", "label_versions"),
    )
}


def keeper(database: Database, storage: Storage, **keep: object) -> Housekeeping:
    assert storage.folder is not None
    return Housekeeping(
        database, storage, load_settings(**{"data_dir": storage.folder.parent, **keep}), queue_client(database.engine)
    )


@pytest.fixture
def store(tmp_path: Path) -> Storage:
    return Storage.open(load_settings(data_dir=tmp_path / "data"))


def job_with_history(database: Database, owner: str, *, ended: bool, webhook: dict[str, Any] | None = None) -> str:
    """A job with its workflow, progress and log lines; one that has ended did so long ago."""
    job_id, client = queued_job(database, owner, webhook), queue_client(database.engine)
    with database.session() as session:
        enqueue(client, session, JOBS, RUN_JOB, job_id, 5)
    with database.session() as session:
        jobs.claim(session, job_id, EXECUTOR)
        jobs.report_progress(session, job_id, EXECUTOR, "render", 0.5)
        jobs.log(session, job_id, EXECUTOR, "info", "a line")
    if ended:
        with database.session() as session:
            jobs.finish(session, job_id, EXECUTOR, "succeeded")
            session.execute(sa.update(Job).where(Job.id == job_id).values(finished_at=OLD, created_at=OLD))
            workflows = sa.table(
                "workflow_status",
                *map(sa.column, ("workflow_uuid", "status", "created_at")),
                schema=engine_schema(database.engine.dialect),
            )
            session.execute(
                sa.update(workflows)
                .where(workflows.c.workflow_uuid == job_id)
                .values(status="SUCCESS", created_at=int(OLD.timestamp() * 1000))
            )
    return job_id


def event_types(database: Database, job_id: str) -> list[str]:
    with database.session() as session:
        return list(session.scalars(sa.select(JobEvent.type).where(JobEvent.job_id == job_id).order_by(JobEvent.seq)))


def test_names_of_requests_go_once_they_may_not_be_sent_again(tables: Database, store: Storage) -> None:
    limit = utc_now() - datetime.timedelta(days=housekeeping.REQUEST_DAYS)
    with tables.session() as session:
        for name, minutes in (("older", -1), ("newer", 1)):
            at = limit + datetime.timedelta(minutes=minutes)
            row = RepeatableRequest(key_id="k", name=name, request_hash="0", object_id="acq_1", salt="0", created_at=at)
            session.add(row)
    assert keeper(tables, store, **NEVER).sweep()["requests"] == 1
    with tables.session() as session:
        assert session.scalars(sa.select(RepeatableRequest.name)).all() == ["newer"]
        assert count_rows(session)["requests"] == 1


def test_sessions_go_a_day_after_their_end(tables: Database, store: Storage) -> None:
    limit = utc_now() - datetime.timedelta(days=housekeeping.SESSION_DAYS)
    key, _ = new_key("tablet", ["read"], project_id=DEFAULT_PROJECT)
    with tables.session() as session:
        session.add(key)
    with tables.session() as session:
        for name, minutes in (("older", -1), ("newer", 1)):
            session.add(SignIn(id=name, key_id=key.id, expires_at=limit + datetime.timedelta(minutes=minutes)))
        assert count_rows(session)["sessions"] == 2
    assert keeper(tables, store, **NEVER).sweep()["sessions"] == 1
    with tables.session() as session:
        assert session.scalars(sa.select(SignIn.id)).all() == ["newer"]


def test_history_of_ended_jobs_goes_and_that_of_others_stays(tables: Database, store: Storage) -> None:
    owner = acquisition(tables)
    ended = job_with_history(tables, owner, ended=True, webhook={"url": "https://ris"})
    running = job_with_history(tables, owner, ended=False)
    with tables.session() as session:
        session.execute(sa.update(Delivery).values(next_at=OLD, state="delivered"))
        session.add(
            AuditEntry(at=OLD, key_id="k", project_id="p", action="a.b", target="t", details={}, correlation_id="")
        )
        session.add(AuditEntry(key_id="k", project_id="p", action="a.b", target="t", details={}, correlation_id=""))
        for state in ("finished", "open"):
            session.add(
                Upload(
                    id=new_id("up"),
                    acquisition_id=owner,
                    role="photo",
                    name="x",
                    size=1,
                    state=state,
                    expires_at=OLD,
                    created_by="k",
                )
            )
    assert set(keeper(tables, store, **NEVER).sweep().values()) == {0}
    found = keeper(tables, store).sweep()
    assert {name: count for name, count in found.items() if count} == {
        "events": 2,
        "workflows": 1,
        "uploads": 1,
        "deliveries": 1,
        "audit": 1,
    }
    assert event_types(tables, ended) == ["state", "state", "state"]
    assert event_types(tables, running) == ["state", "state", "progress", "log"]
    left = queue_client(tables.engine).list_workflows(load_input=False, load_output=False)
    assert [workflow.workflow_id for workflow in left] == [running]
    with tables.session() as session:
        counted = count_rows(session)
        assert session.get_one(Job, ended).state == "succeeded"
    assert {name: counted[name] for name in ("events", "workflows", "uploads", "deliveries", "audit")} == {
        "events": 7,
        "workflows": 1,
        "uploads": 1,
        "deliveries": 0,
        # With the one that tells of the removal.
        "audit": 2,
    }
    assert set(keeper(tables, store).sweep().values()) == {0}


def test_a_workflow_stays_as_long_as_its_job_has_not_ended(tables: Database, store: Storage) -> None:
    job_id = job_with_history(tables, acquisition(tables), ended=True)
    with tables.session() as session:
        session.execute(sa.update(Job).values(state="running"))
    assert keeper(tables, store).sweep()["workflows"] == 0
    left = queue_client(tables.engine).list_workflows(load_input=False, load_output=False)
    assert [workflow.workflow_id for workflow in left] == [job_id]


def artefact(database: Database, storage: Storage, owner: str, stage: str, made: datetime.datetime) -> str:
    key = f"acquisitions/{owner}/stages/{new_id('att')}.npz"
    storage.put(key, b"an artefact")
    with database.session() as session:
        session.add(
            Artefact(
                id=new_id("att"),
                acquisition_id=owner,
                stage=stage,
                key="k",
                storage_key=key,
                size=11,
                seconds=1.0,
                created_at=made,
            )
        )
    return key


def is_stored(storage: Storage, key: str) -> bool:
    try:
        return storage.stat(key).size > 0
    except NotFoundError:
        return False


def test_artefacts_go_when_no_job_of_their_acquisition_needs_them(tables: Database, store: Storage) -> None:
    done, busy, fresh = acquisition(tables), acquisition(tables), acquisition(tables)
    for owner in (done, busy):
        job_with_history(tables, owner, ended=True)
    job_with_history(tables, busy, ended=False)
    kept = [artefact(tables, store, busy, "render", OLD), artefact(tables, store, fresh, "render", utc_now())]
    gone = artefact(tables, store, done, "render", OLD)
    assert keeper(tables, store).sweep()["artefacts"] == 1
    assert [is_stored(store, key) for key in (*kept, gone)] == [True, True, False]
    with tables.session() as session:
        assert set(session.scalars(sa.select(Artefact.storage_key))) == set(kept)


def test_old_exports_are_made_again_on_request(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    client: httpx.Client = service.client()
    export = client.post(f"/v1/clouds/{result.cloud_id}/exports/ply").json()
    key = f"exports/{export['id']}/one/cloud.ply"
    service.storage.put(key, b"ply")
    sweeping = keeper(service.database, service.storage)
    with service.database.session() as session:
        session.execute(sa.update(Export).values(created_at=OLD))
    assert sweeping.sweep()["exports"] == 0, "it is still being made"
    with service.database.session() as session:
        session.execute(sa.update(Export).values(state="succeeded", storage_key=key, size=3))
    assert sweeping.sweep()["exports"] == 1
    assert not is_stored(service.storage, key)
    again = client.post(f"/v1/clouds/{result.cloud_id}/exports/ply")
    assert (again.status_code, again.json()["state"]) == (202, "queued")
    assert client.get(f"/v1/clouds/{result.cloud_id}").status_code == 200


def test_versions_of_labels_go_only_on_request_and_never_the_newest(service: Running, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result")
    for _ in range(4):
        put_label(service, result, "tissue", np.zeros(result.cloud.n_points, np.float32))
    put_label(service, result, "other", np.zeros(result.cloud.n_points, np.float32))
    assert keeper(service.database, service.storage).sweep()["labels"] == 0
    with service.database.session() as session:
        prefixes = dict(
            session.execute(
                sa.select(LabelVersion.version, LabelVersion.storage_prefix).where(LabelVersion.name == "tissue")
            ).all()
        )
    assert keeper(service.database, service.storage, keep_label_versions=2).sweep()["labels"] == 2
    with service.database.session() as session:
        left = session.execute(sa.select(LabelVersion.name, LabelVersion.version)).all()
        told = session.scalars(sa.select(AuditEntry.details).where(AuditEntry.action == "label.expire")).all()
    assert sorted(tuple(row) for row in left) == [("other", 1), ("tissue", 3), ("tissue", 4)]
    assert sorted(entry["version"] for entry in told) == [1, 2]
    there = {version: is_stored(service.storage, f"{prefix}/zarr.json") for version, prefix in prefixes.items()}
    assert there == {1: False, 2: False, 3: True, 4: True}


def test_leftovers_of_killed_processes_go_and_what_is_of_others_stays(
    tables: Database, store: Storage, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert store.folder is not None
    scratch = tmp_path / "data" / "scratch"
    ours = [scratch / f"label-{'0' * 32}.tmp", scratch / f"{'a' * 32}.tmp", scratch / "exp_1-00000000.tmp"]
    others = [scratch / "somebody.tmp", scratch / "uploads", scratch / "work"]
    aside = store.folder / "tmp" / "cloud.00000000.tmp"
    for path in (*ours, *others, aside):
        (path / "inside").mkdir(parents=True)
    sweeping = keeper(tables, store)
    assert sweeping.sweep()["leftovers"] == 0, "they may be at work"
    later = time.time() + housekeeping.LEFTOVER_SECONDS + 60
    monkeypatch.setattr("specimap_infra.housekeeping.time.time", lambda: later)
    assert sweeping.sweep()["leftovers"] == 4
    assert [path.exists() for path in (*ours, aside, *others)] == [False] * 4 + [True] * 3


def test_a_rule_that_fails_leaves_the_others_to_their_work(
    tables: Database, store: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = acquisition(tables)
    job_with_history(tables, owner, ended=True)
    artefact(tables, store, owner, "render", OLD)

    def fail(*_: object) -> None:
        raise SpecimapError("The store is away.")

    monkeypatch.setattr(store, "delete", fail)
    found = keeper(tables, store).sweep()
    assert (found["artefacts"], found["events"], found["workflows"]) == (0, 2, 1)


def test_metrics_count_what_is_kept(service: Running, tmp_path: Path) -> None:
    put_result(service, tmp_path / "result")
    (service.settings.scratch / "uploads").mkdir(exist_ok=True)
    (service.settings.scratch / "uploads" / "x").write_bytes(b"12345")
    text = service.client().get("/metrics").text
    for line in (
        'specimap_rows_keep{kind="labels"} 0.0',
        'specimap_rows_keep{kind="leases"} 0.0',
        "specimap_scratch_use_bytes 5.0",
        'specimap_storage_use_bytes{kind="exports"} 0.0',
    ):
        assert line in text
    kinds = ("artefacts", "audit", "deliveries", "events", "exports", "labels", "leases", "uploads", "workflows")
    assert all(f'specimap_rows_keep{{kind="{kind}"}}' in text for kind in kinds)


@pytest.mark.slow
def test_a_worker_sweeps_while_it_works(tmp_path: Path) -> None:
    with shop(tmp_path / "shop") as yard:
        owner = acquisition(yard.database)
        job_with_history(yard.database, owner, ended=True)
        gone = artefact(yard.database, yard.storage, owner, "render", OLD)
        yard.start(QUICK)
        until(lambda: not is_stored(yard.storage, gone), 60, "the sweep")
