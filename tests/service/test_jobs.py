"""Jobs over HTTP: made once, listed, cancelled, repeated, deleted."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra import jobs
from specimap_infra.queue import enqueue
from specimap_infra.tables import Job, JobEvent
from specimap_service.jobs import commands
from tests.support.job_scene import EXECUTOR, acquisition, events, queued_job, row
from tests.support.service_scene import Running, serving


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    """A service on each kind of database."""
    with serving(tmp_path / "service", database_url=any_database) as running:
        yield running


def workflows(service: Running, **filters: Any) -> dict[str, str]:
    """States by id, as the job engine has them."""
    found = service.app.state.context.queue.list_workflows(load_input=False, load_output=False, **filters)
    return {w.workflow_id: w.status for w in found}


def test_job_is_queued_with_its_workflow_and_first_event(any_service: Running) -> None:
    owner = acquisition(any_service.database, edge_mm=7.5)
    client = any_service.client(("upload", "read", "intraoperative"))
    wanted = {"acquisition_id": owner, "settings": {"r_pc": 0.25}, "priority": "intraoperative"}
    answer = client.post("/v1/jobs", json=wanted, headers={"X-Correlation-Id": "theatre-2.0001"})
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert client.get(answer.headers["location"]).json() == job
    assert job["settings"] == {
        "method": "camera",
        "adjustment": "rigid",
        "r_pc": 0.25,
        "r_reg": 2.0,
        "backend": "colmap",
        "features": "auto",
        "working_px": 1280,
        "dictionary": "DICT_4X4_50",
        "edge_mm": 7.5,
    }
    expected: dict[str, Any] = {
        "acquisition_id": owner,
        "priority": "intraoperative",
        "state": "queued",
        "stage": None,
        "progress": 0.0,
        "error": None,
        "starts": 0,
        "rerun_of": None,
        "cloud_id": None,
        "seconds": {},
        "started_at": None,
        "finished_at": None,
        "queue_position": 0,
    }
    assert {name: job[name] for name in expected} == expected
    assert workflows(any_service) == {job["id"]: "ENQUEUED"}
    assert [(e.seq, e.data["state"]) for e in events(any_service.database, job["id"])] == [(1, "queued")]
    assert row(any_service.database, job["id"]).correlation_id == "theatre-2.0001"
    (entry,) = any_service.client().get("/v1/audit", params={"target": job["id"]}).json()["items"]
    assert (entry["action"], entry["correlation_id"]) == ("job.create", "theatre-2.0001")


@pytest.mark.slow
def test_job_and_workflow_are_there_together_or_not_at_all(
    any_service: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    owner = acquisition(any_service.database)
    client = any_service.client()

    def fails_after(*arguments: Any) -> None:
        enqueue(*arguments)
        raise OSError("The process dies here.")

    monkeypatch.setattr(commands, "enqueue", fails_after)
    assert client.post("/v1/jobs", json={"acquisition_id": owner}).status_code == 500
    monkeypatch.undo()
    with any_service.database.session() as session:
        counts = [session.scalar(sa.select(sa.func.count()).select_from(table)) for table in (Job, JobEvent)]
    assert counts == [0, 0]
    assert workflows(any_service) == {}
    assert client.get("/v1/audit").json()["items"] == []


def test_same_request_at_once_makes_one_job(any_service: Running) -> None:
    owner = acquisition(any_service.database)
    client = any_service.client()

    def ask(_: int) -> tuple[int, str]:
        answer = client.post("/v1/jobs", json={"acquisition_id": owner}, headers={"Idempotency-Key": "case 17"})
        return answer.status_code, answer.json()["id"]

    with ThreadPoolExecutor(10) as pool:
        answers = list(pool.map(ask, range(10)))
    assert sorted(status for status, _ in answers) == [200] * 9 + [202]
    assert {job_id for _, job_id in answers} == set(workflows(any_service))
    assert len(client.get("/v1/jobs").json()["items"]) == 1


def test_idempotency_key_belongs_to_one_request_of_one_key(service: Running) -> None:
    owner = acquisition(service.database)
    one, other = service.client(), service.client()
    headers = {"Idempotency-Key": "case-17"}
    first = one.post("/v1/jobs", json={"acquisition_id": owner}, headers=headers).json()["id"]
    changed = one.post("/v1/jobs", json={"acquisition_id": owner, "priority": "research"}, headers=headers)
    assert (changed.status_code, changed.json()["code"]) == (409, "idempotency_conflict")
    assert changed.json()["details"] == {"job_id": first}
    # The defaults, spelt out, are the same request.
    spelt = {"acquisition_id": owner, "settings": {"method": "camera"}, "priority": "routine"}
    assert one.post("/v1/jobs", json=spelt, headers=headers).json()["id"] == first
    assert other.post("/v1/jobs", json={"acquisition_id": owner}, headers=headers).json()["id"] != first
    for bad in ("x" * 129, "tab\there"):
        refused = one.post("/v1/jobs", json={"acquisition_id": owner}, headers={"Idempotency-Key": bad})
        assert refused.status_code == 422


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"settings": {"r_pc": 0}}, "body.settings.r_pc"),
        ({"settings": {"r_pc": 1e-4}}, "body.settings.r_pc"),
        ({"settings": {"r_reg": 1e9}}, "body.settings.r_reg"),
        ({"settings": {"working_px": 10}}, "body.settings.working_px"),
        ({"settings": {"method": "magic"}}, "body.settings.method"),
        ({"settings": {"backend": "nerf"}}, "body.settings.backend"),
        ({"settings": {"dictionary": "DICT_9X9"}}, "body.settings.dictionary"),
        ({"settings": {"edge_mm": -1}}, "body.settings.edge_mm"),
        ({"settings": {"r_px": 1}}, "body.settings.r_px"),
        ({"priority": "now"}, "body.priority"),
        ({"more": 1}, "body.more"),
        ({"acquisition_id": "acq_1"}, "body.acquisition_id"),
        ({"webhook": {"url": "https://a.example/", "secret": "short"}}, "body.webhook.secret"),
    ],
)
def test_requests_that_cannot_be_name_the_field(service: Running, change: dict[str, Any], where: str) -> None:
    body = {"acquisition_id": acquisition(service.database), **change}
    answer = service.client().post("/v1/jobs", json=body)
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert where in {field["where"] for field in answer.json()["details"]["fields"]}


def test_incomplete_or_unknown_acquisition_is_refused(service: Running) -> None:
    client = service.client()
    incomplete = acquisition(service.database, photos=3, others=["cube.hdr"])
    answer = client.post("/v1/jobs", json={"acquisition_id": incomplete})
    assert (answer.status_code, answer.json()["code"]) == (409, "upload_incomplete")
    assert len(answer.json()["details"]["missing"]) == 2
    unknown = client.post("/v1/jobs", json={"acquisition_id": "acq_" + "0" * 26})
    assert (unknown.status_code, unknown.json()["code"]) == (404, "not_found")
    assert service.client(["read"]).post("/v1/jobs", json={"acquisition_id": incomplete}).status_code == 403


def test_queue_goes_by_priority_then_age(any_service: Running) -> None:
    owner = acquisition(any_service.database)
    client = any_service.client()
    wanted = ("research", "routine", "routine", "intraoperative")
    ids = [client.post("/v1/jobs", json={"acquisition_id": owner, "priority": p}).json()["id"] for p in wanted]
    listed = client.get("/v1/jobs").json()["items"]
    assert [job["id"] for job in listed] == ids[::-1]
    assert {job["id"]: job["queue_position"] for job in listed} == dict(zip(ids, (3, 1, 2, 0), strict=True))
    with any_service.database.session() as session:
        jobs.claim(session, ids[3], EXECUTOR)
    assert client.get(f"/v1/jobs/{ids[1]}").json()["queue_position"] == 0
    assert client.get(f"/v1/jobs/{ids[3]}").json()["queue_position"] is None


def test_list_is_filtered_and_paged(any_service: Running) -> None:
    first, second = acquisition(any_service.database), acquisition(any_service.database)
    ids = [queued_job(any_service.database, owner) for owner in (first, first, second, second, second)]
    with any_service.database.session() as session:
        jobs.request_cancel(session, ids[4])
    client = any_service.client(["read"])

    def listed(**filters: Any) -> list[str]:
        return [job["id"] for job in client.get("/v1/jobs", params=filters).json()["items"]]

    assert listed(acquisition_id=second) == ids[:1:-1]
    assert listed(state="cancelled") == [ids[4]]
    assert listed(state=["cancelled", "queued"], acquisition_id=second) == ids[:1:-1]
    middle = client.get(f"/v1/jobs/{ids[2]}").json()["created_at"]
    assert listed(created_after=middle) == ids[:1:-1]
    assert listed(created_before=middle) == ids[1::-1]
    page = client.get("/v1/jobs", params={"limit": 3}).json()
    assert [job["id"] for job in page["items"]] == ids[:1:-1]
    assert listed(limit=3, after=page["next"]) == ids[1::-1]
    wrong: dict[str, str] = {
        "after": "\0",
        "state": "lost",
        "limit": "0",
        "acquisition_id": "x",
        "created_after": "0001-01-01T00:00+14:00",
    }
    for name, value in wrong.items():
        assert client.get("/v1/jobs", params={name: value}).status_code == 422, name


def test_cancelled_job_never_starts(any_service: Running) -> None:
    owner = acquisition(any_service.database)
    client = any_service.client(("upload", "read", "admin"))
    job_id = client.post("/v1/jobs", json={"acquisition_id": owner}).json()["id"]
    for _ in range(2):
        answer = client.post(f"/v1/jobs/{job_id}/cancel")
        assert (answer.status_code, answer.json()["state"]) == (202, "cancelled")
    assert workflows(any_service) == {job_id: "CANCELLED"}
    with any_service.database.session() as session:
        assert jobs.claim(session, job_id, EXECUTOR) is None
    actions = [e["action"] for e in client.get("/v1/audit", params={"target": job_id}).json()["items"]]
    assert actions == ["job.cancel", "job.create"]


def test_cancel_of_what_has_no_workflow_or_has_ended(service: Running) -> None:
    client = service.client()
    bare = queued_job(service.database)
    assert client.post(f"/v1/jobs/{bare}/cancel").json()["state"] == "cancelled"
    done = queued_job(service.database)
    with service.database.session() as session:
        jobs.claim(session, done, EXECUTOR)
        jobs.finish(session, done, EXECUTOR, "succeeded")
    answer = client.post(f"/v1/jobs/{done}/cancel")
    assert (answer.status_code, answer.json()["code"]) == (409, "state_conflict")
    assert client.post(f"/v1/jobs/job_{'0' * 26}/cancel").status_code == 404


def test_deletion_of_the_acquisition_meanwhile_is_told(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    owner = acquisition(service.database)

    def deletes(session: Session, acquisition_id: str) -> list[str]:
        with service.database.engine.begin() as connection:
            connection.execute(sa.text("DELETE FROM acquisitions"))
        return []

    monkeypatch.setattr(commands, "missing", deletes)
    answer = service.client().post("/v1/jobs", json={"acquisition_id": owner})
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")
