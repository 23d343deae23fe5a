"""What projects and their keys share, and what administrators see of them."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from specimap_infra.projects import DEFAULT_PROJECT
from tests.support.job_scene import acquisition, queued_job
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import new_acquisition, photos, sent


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database) as running:
        yield running


def test_administrator_filters_lists_by_project(any_service: Running) -> None:
    administrator = any_service.client()
    made = {}
    for name in ("one", "two"):
        answer = administrator.post("/v1/projects", json={"name": name})
        assert answer.status_code == 201, answer.text
        made[answer.json()["id"]] = name
    owners = {project: acquisition(any_service.database, project=project) for project in made}
    jobs = {project: queued_job(any_service.database, owners[project]) for project in made}
    for project, name in made.items():
        for wanted in (project, name):
            for path, ids in (("/v1/acquisitions", owners), ("/v1/jobs", jobs)):
                listed = administrator.get(path, params={"project": wanted}).json()["items"]
                assert [item["id"] for item in listed] == [ids[project]]
        key = administrator.post("/v1/keys", json={"name": "x", "scopes": ["read"], "project": name}).json()
        assert [k["id"] for k in administrator.get("/v1/keys", params={"project": name}).json()] == [key["id"]]
        audited = administrator.get("/v1/audit", params={"project": name}).json()["items"]
        assert [(e["action"], e["target"]) for e in audited] == [("key.create", key["id"]), ("project.create", project)]
    assert {job["id"] for job in administrator.get("/v1/jobs").json()["items"]} == set(jobs.values())


def test_object_belongs_to_the_project_of_its_acquisition(any_service: Running) -> None:
    ours, theirs = any_service.project("ours"), any_service.project("theirs")
    administrator = any_service.client(project=ours)
    reader, other = (any_service.client(["read"], project=project) for project in (ours, theirs))
    own = new_acquisition(administrator)
    assert reader.get(f"/v1/acquisitions/{own}").json()["project_id"] == ours
    assert other.get(f"/v1/acquisitions/{own}").status_code == 404
    # What an administrator does elsewhere stays there: an acquisition and its jobs are never divided.
    owner = acquisition(any_service.database, project=theirs)
    job = administrator.post("/v1/jobs", json={"acquisition_id": owner}).json()["id"]
    assert other.get(f"/v1/jobs/{job}").status_code == 200
    assert reader.get(f"/v1/jobs/{job}").status_code == 404
    (entry,) = administrator.get("/v1/audit", params={"target": job}).json()["items"]
    assert entry["project_id"] == theirs


def test_keys_of_a_project_trust_each_other(service: Running) -> None:
    first, second = service.client(["upload", "read"]), service.client(["upload", "read"])
    owner = acquisition(service.database)
    job = first.post("/v1/jobs", json={"acquisition_id": owner}).json()["id"]
    assert second.post(f"/v1/jobs/{job}/cancel").json()["state"] == "cancelled"
    made = new_acquisition(first)
    file = sent(first, made, "photo", "x", b"x")["id"]
    assert second.delete(f"/v1/acquisitions/{made}/files/{file}").status_code == 204


def test_same_photo_and_same_idempotency_key_elsewhere_do_not_show(service: Running) -> None:
    projects = [service.project("one"), service.project("two")]
    photo = photos()[0].read_bytes()
    labels, jobs = [], []
    for project in projects:
        client = service.client(["upload"], project=project)
        file = sent(client, new_acquisition(client), "photo", "x.jpg", photo)
        labels.append((file["label"], file["judgement"]["same_as"]))
        answer = client.post(
            "/v1/jobs",
            json={"acquisition_id": acquisition(service.database, project=project)},
            headers={"Idempotency-Key": "the-same"},
        )
        assert answer.status_code == 202
        jobs.append(answer.json()["id"])
    assert labels == [("photo-0001.jpg", None)] * 2
    assert jobs[0] != jobs[1]


def test_place_of_theatre_in_the_queue_is_a_right(service: Running) -> None:
    owner = acquisition(service.database)
    theatre, ward = service.client(["upload", "intraoperative"]), service.client(["upload"])
    wanted = {"acquisition_id": owner, "priority": "intraoperative"}
    refused = ward.post("/v1/jobs", json=wanted)
    assert (refused.status_code, refused.json()["code"]) == (403, "forbidden")
    assert refused.json()["details"] == {"scope": "intraoperative"}
    assert "routine" in refused.json()["advice"]
    made = theatre.post("/v1/jobs", json=wanted)
    assert (made.status_code, made.json()["priority"]) == (202, "intraoperative")
    again = f"/v1/jobs/{made.json()['id']}/rerun"
    # The earlier job's priority is no way around it.
    for body in (None, {"priority": "intraoperative"}):
        assert ward.post(again, json=body).json()["details"] == {"scope": "intraoperative"}
    assert ward.post(again, json={"priority": "routine"}).json()["priority"] == "routine"
    assert theatre.post(again).json()["priority"] == "intraoperative"
    assert service.client(["admin"]).post("/v1/jobs", json=wanted).status_code == 202


def test_projects_are_named_and_renamed(any_service: Running) -> None:
    administrator = any_service.client()
    (default,) = administrator.get("/v1/projects").json()
    assert (default["id"], default["name"]) == (DEFAULT_PROJECT, "default")
    made = administrator.post("/v1/projects", json={"name": "study-7"}).json()
    taken = administrator.post("/v1/projects", json={"name": "study-7"})
    assert (taken.status_code, taken.json()["code"]) == (409, "state_conflict")
    for name in ("", "prj_1", "Anna Muster", "a" * 65, "a/b", "a\n"):
        refused = administrator.post("/v1/projects", json={"name": name})
        assert refused.status_code == 422, name
        assert refused.json()["advice"]
    at = f"/v1/projects/{made['id']}"
    assert administrator.patch(at, json={"name": "default"}).status_code == 409
    renamed = administrator.patch(at, json={"name": "study-8"}).json()
    assert renamed == {**made, "name": "study-8"} == administrator.get(at).json()
    key = administrator.post("/v1/keys", json={"name": "x", "scopes": ["read"], "project": "study-8"}).json()
    assert key["project_id"] == made["id"]
    unknown = administrator.post("/v1/keys", json={"name": "x", "scopes": ["read"], "project": "study-7"})
    assert (unknown.status_code, unknown.json()["code"]) == (404, "not_found")
    assert (
        administrator.post("/v1/keys", json={"name": "x", "scopes": ["read"]}).json()["project_id"] == DEFAULT_PROJECT
    )
    with httpx.Client(base_url=any_service.url, trust_env=False, verify=NO_TLS) as holder:
        holder.headers["Authorization"] = f"Bearer {key['key']}"
        assert holder.get("/v1/projects").json() == [renamed]
    audited = administrator.get("/v1/audit", params={"target": made["id"]}).json()["items"]
    assert [entry["action"] for entry in audited] == ["project.rename", "project.create"]
