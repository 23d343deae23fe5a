"""Who may touch what: every operation of the contract, by every scope, from the objects' project and from others."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from fastapi.dependencies.models import Dependant
from fastapi.routing import iter_route_contexts

from specimap_infra.database import Database
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.tables import Base
from specimap_service.auth.dependencies import known_principal
from specimap_service.auth.object_ids import GUARDS
from specimap_service.uploads.tus_routes import _check_request
from tests.support.access_scene import CASES, LESSER_SCOPES, OTHERS, make_world
from tests.support.documented import contract
from tests.support.job_scene import acquisition, queued_job
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import new_acquisition, photos, sent

NO_KEY = {("GET", "/healthz"), ("GET", "/readyz")}


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database) as running:
        yield running


def test_every_operation_has_a_case() -> None:
    described = contract()
    operations = {
        (method.upper(), path): operation
        for path, methods in described["paths"].items()
        for method, operation in methods.items()
    }
    assert {known for known, operation in operations.items() if not operation.get("security")} == NO_KEY
    assert set(operations) - NO_KEY == set(CASES), "describe new operations in tests/support/access_scene.py"
    for (method, path), case in CASES.items():
        named = set(re.findall(r"{(\w+)}", path)) - {*OTHERS, "name"}
        assert case.aims or not named, f"{method} {path} names an object"


def test_no_route_takes_an_id_past_the_check(service: Running) -> None:
    def dependencies(dependant: Dependant) -> Iterator[Any]:
        for inner in dependant.dependencies:
            yield inner.call
            yield from dependencies(inner)

    routes = [route for route in iter_route_contexts(service.app.routes) if str(route.path).startswith("/v1/")]
    assert {(method, route.path_format) for route in routes for method in route.methods or ()} >= {
        (method, path) for method, path in CASES if path.startswith("/v1/")
    }
    for route in routes:
        checks = set(dependencies(route.dependant))
        assert known_principal in checks, route.path
        names = set(re.findall(r"{(\w+)}", str(route.path_format)))
        for name in names - {*OTHERS, "name"}:
            if name == "file_id":
                # A file is looked for within its acquisition.
                assert "acquisition_id" in names, route.path
            elif name == "uuid":
                assert _check_request in checks, route.path
            else:
                assert GUARDS[name] in checks, f"{route.path}: declare {name} by its type of auth/object_ids.py"


def test_key_does_what_its_scope_says_in_its_project(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    holders = {scope: any_service.client([scope], project=project) for scope in (*LESSER_SCOPES, "admin")}
    world = make_world(any_service, tmp_path / "result", project, holders["upload"])
    for (method, path), case in CASES.items():
        for scope in LESSER_SCOPES:
            if scope == case.scope:
                continue
            answer = case.send(holders[scope], method, path, world)
            assert answer.status_code == 403, f"{method} {path} with {scope}: {answer.text[:300]}"
            if method != "HEAD":
                assert (answer.json()["code"], answer.json()["details"]) == ("forbidden", {"scope": case.scope})
        answer = case.send(holders[case.scope], method, path, world)
        assert answer.status_code == case.status, f"{method} {path}: {answer.status_code} {answer.text[:300]}"


def test_administrator_does_everything_in_every_project(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    world = make_world(any_service, tmp_path / "result", project, any_service.client(["upload"], project=project))
    administrator = any_service.client(["admin"], project=any_service.project("ours"))
    for (method, path), case in CASES.items():
        answer = case.send(administrator, method, path, world)
        assert answer.status_code == case.status, f"{method} {path}: {answer.status_code} {answer.text[:300]}"


def test_objects_of_another_project_do_not_exist(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    holders = {scope: any_service.client([scope], project=project) for scope in LESSER_SCOPES}
    world = make_world(any_service, tmp_path / "result", project, holders["upload"])
    for (method, path), case in CASES.items():
        # Whatever is cached of an object that is in use must not show either.
        if method in ("GET", "HEAD") and case.scope != "admin":
            assert case.send(holders[case.scope], method, path, world).is_success
    stranger = any_service.client(LESSER_SCOPES, project=any_service.project("ours"))
    before = contents(any_service.database)
    for (method, path), case in CASES.items():
        if not case.aims:
            continue
        with statements(any_service.database) as theirs:
            answer = case.send(stranger, method, path, world)
        with statements(any_service.database) as absent:
            expected = case.send(stranger, method, path, world.absent())
        told = f"{method} {path}: {answer.status_code} {answer.text[:300]}"
        assert answer.status_code == (403 if case.scope == "admin" else 404), told
        assert seen(answer) == seen(expected), told
        # The same work takes the same time.
        assert theirs == absent, told
        if case.scope != "admin":
            assert theirs, told
    assert contents(any_service.database) == before


def test_lists_and_filters_show_nothing_of_another_project(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    holder = any_service.client(["upload", "read"], project=project)
    world = make_world(any_service, tmp_path / "result", project, holder)
    stranger = any_service.client(LESSER_SCOPES, project=any_service.project("ours"))
    own = new_acquisition(stranger)
    absent, lists = (
        world.absent(),
        [path for (method, path), case in CASES.items() if method == "GET" and not case.aims],
    )
    assert {"/v1/acquisitions", "/v1/jobs", "/v1/clouds", "/v1/projects"} < set(lists)
    for path in lists:
        if CASES["GET", path].scope == "admin":
            continue
        text = stranger.get(path).text
        assert not [known for known in world.strings() if known in text], path
    filters = [
        ("/v1/acquisitions", "after", "acquisition_id"),
        ("/v1/jobs", "after", "job_id"),
        ("/v1/clouds", "after", "cloud_id"),
        ("/v1/jobs", "acquisition_id", "acquisition_id"),
        ("/v1/clouds", "acquisition_id", "acquisition_id"),
        ("/v1/acquisitions", "project", "project_id"),
        ("/v1/jobs", "project", "project_id"),
        ("/v1/clouds", "project", "project_id"),
    ]
    for path, name, kind in filters:
        theirs = stranger.get(path, params={name: world.ids[kind]})
        assert theirs.status_code == 200
        if name != "after":
            assert (
                theirs.json()
                == stranger.get(path, params={name: absent.ids[kind]}).json()
                == {"items": [], "next": None}
            )
    assert stranger.get("/v1/acquisitions", params={"project": "theirs"}).json()["items"] == []
    for path in ("/v1/acquisitions", "/v1/clouds"):
        for more in ({}, {"project": "theirs"}, {"project": "ours"}):
            assert stranger.get(path, params={"specimen_id": "S-1", **more}).json()["items"] == []
            found = holder.get(path, params={"specimen_id": "S-1", **more}).json()["items"]
            assert bool(found) == (more != {"project": "ours"}), (path, more)
    for wanted in ("ours", None):
        listed = stranger.get("/v1/acquisitions", params={} if wanted is None else {"project": wanted}).json()["items"]
        assert [item["id"] for item in listed] == [own]


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


def test_file_is_looked_for_in_its_acquisition_only(service: Running) -> None:
    theirs = service.client(["upload", "read"], project=service.project("theirs"))
    ours = service.client(["upload", "read"])
    elsewhere, own = new_acquisition(theirs), new_acquisition(ours)
    foreign = sent(theirs, elsewhere, "photo", "x", b"x")["id"]
    for method, end in (("GET", ""), ("GET", "/content"), ("DELETE", "")):
        answer = ours.request(method, f"/v1/acquisitions/{own}/files/{foreign}{end}")
        expected = ours.request(method, f"/v1/acquisitions/{own}/files/file_{'0' * 26}{end}")
        assert answer.status_code == 404
        assert seen(answer) == seen(expected)


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


# ---- comparing ----------------------------------------------------------------------------------------


def seen(answer: httpx.Response) -> tuple[int, dict[str, str], str]:
    """Everything that an answer tells, but for its moment, its turn, and the ids that the request named."""
    # Each request of a key leaves it one less, whatever it asks for.
    headers = {k: v for k, v in answer.headers.items() if k not in ("date", "x-correlation-id", "ratelimit")}
    text = re.sub(r"\b([a-z]{2,5})_[0-9a-z]{26}\b", r"\1", answer.text)
    return answer.status_code, headers, re.sub(r'"correlation_id":"\w+"', "", text)


def contents(database: Database) -> dict[str, list[Any]]:
    """All rows, but for the time at which a key was last used."""
    with database.session() as session:
        return {
            name: sorted(session.execute(sa.select(*(c for c in table.c if c.name != "last_used_at"))).all(), key=str)
            for name, table in Base.metadata.tables.items()
        }


@contextmanager
def statements(database: Database) -> Iterator[list[str]]:
    """The statements that the database gets meanwhile, but for the look-up of keys."""
    found: list[str] = []

    def note(_: Any, __: Any, statement: str, *___: Any) -> None:
        if "secret_hash" not in statement and "last_used_at" not in statement:
            found.append(statement)

    sa.event.listen(database.engine, "before_cursor_execute", note)
    try:
        yield found
    finally:
        sa.event.remove(database.engine, "before_cursor_execute", note)
