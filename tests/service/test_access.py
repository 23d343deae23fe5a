"""Who may touch what: every operation of the contract, by every scope, from the objects' project and from others."""

from __future__ import annotations

import re
import threading
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
from specimap_infra.settings.identity import PERSON_ROLES
from specimap_infra.study_keys import new_key
from specimap_infra.tables import SCOPES, Base
from specimap_service.auth.dependencies import known_principal
from specimap_service.auth.object_ids import GUARDS
from specimap_service.auth.permissions import (
    AUDIT_ALL,
    EQUIVALENT,
    EVERYTHING,
    OPERATIONS,
    ROLES,
    SCOPE_PERMISSIONS,
    SEND,
    SHARE,
    STUDY,
    of_scopes,
    roles_for,
    scope_for,
)
from specimap_service.contract.description import operations
from specimap_service.uploads.tus_routes import _check_request
from tests.support.access_scene import CASES, LESSER_SCOPES, NO_KEY, OTHERS, make_world
from tests.support.documented import contract
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import new_acquisition, sent

CHAIN = ("seq", "previous_hash", "hash")
"""What the sealer adds to an entry."""


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    hospital: dict[str, Any] = {
        "study_keys": [new_key()],
        "pacs_url": "http://127.0.0.1:9",
        "fhir_url": "http://127.0.0.1:9",
    }
    with serving(tmp_path / "service", database_url=any_database, **hospital) as running:
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
        if {(method, route.path_format) for method in route.methods or ()} <= NO_KEY:
            continue
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
            if case.scope in (scope, None):
                continue
            answer = case.send(holders[scope], method, path, world)
            assert answer.status_code == 403, f"{method} {path} with {scope}: {answer.text[:300]}"
            if method != "HEAD":
                assert (answer.json()["code"], answer.json()["details"]) == ("forbidden", {"scope": case.scope})
        holder = holders[case.scope or "read"]
        if case.also:
            holder = any_service.client([case.scope or "read", *case.also], project=project)
        answer = case.send(holder, method, path, world)
        assert answer.status_code == case.status, f"{method} {path}: {answer.status_code} {answer.text[:300]}"


def test_the_table_of_permissions_has_every_operation_and_nothing_else() -> None:
    asked = {
        operation["operationId"]
        for method, path, operation in operations(contract())
        if (method.upper(), path) not in NO_KEY
    }
    assert asked <= set(OPERATIONS), "say who may do it in service/specimap_service/auth/permissions.py"
    assert set(OPERATIONS) <= asked, "these operations are gone: take them out of the table"
    assert {held for held in OPERATIONS.values() if held is not None} <= EVERYTHING
    assert set(ROLES) == set(PERSON_ROLES)
    assert set(SCOPE_PERMISSIONS) == set(SCOPES)
    for permission in EVERYTHING:
        assert roles_for(permission), permission
        assert permission in SCOPE_PERMISSIONS[scope_for(permission)]
    # Only those that see all projects anyway see their trails; every other key sees its own project's.
    assert [scope for scope in SCOPES if AUDIT_ALL in SCOPE_PERMISSIONS[scope]] == ["admin"]
    for role, scopes in EQUIVALENT.items():
        assert of_scopes(scopes) ^ ROLES[role] <= {SHARE, STUDY, SEND, AUDIT_ALL}, role


def test_person_does_what_the_role_says_in_its_projects(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    other = any_service.project("also-theirs")
    holders = {role: any_service.person_client([role], [project, other]) for role in ROLES}
    nobody = any_service.person_client([], [project])
    world = make_world(any_service, tmp_path / "result", project, holders["technician"])
    for (method, path), case in CASES.items():
        permission = OPERATIONS[operation_at(method, path)]
        allowed = [role for role in ROLES if permission in ROLES[role]]
        for role, holder in {**holders, "none": nobody}.items():
            if permission is None or role in allowed:
                continue
            answer = case.send(holder, method, path, world)
            assert answer.status_code == 403, f"{method} {path} as {role}: {answer.text[:300]}"
            if method != "HEAD":
                assert (answer.json()["code"], answer.json()["details"]) == ("forbidden", {"permission": permission})
        # The least of those that may; the last one signs out, which ends a session of its own.
        holder = any_service.person_client(["auditor"], []) if permission is None else holders[least(allowed)]
        answer = case.send(holder, method, path, world)
        needs_project = (method, path) in {("POST", "/v1/acquisitions"), ("POST", "/v1/keys")}
        if needs_project:
            assert (answer.status_code, answer.json()["details"]["projects"]) == (422, sorted([project, other]))
            body = {**case.given(world)["json"], "project": project}
            answer = holder.request(method, path, json=body)
        assert answer.status_code == case.status, f"{method} {path}: {answer.status_code} {answer.text[:300]}"


def operation_at(method: str, path: str) -> str:
    found: str = contract()["paths"][path][method.lower()]["operationId"]
    return found


def least(roles: list[str]) -> str:
    return min(roles, key=lambda role: (role != "technician", len(ROLES[role])))


def test_auditor_reads_the_trail_and_nothing_clinical(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    world = make_world(any_service, tmp_path / "result", project, any_service.client(project=project))
    auditor = any_service.person_client(["auditor"], [])
    read = [path for (method, path), case in CASES.items() if auditor_may(method, path)]
    assert read == ["/v1/audit"]
    entries = auditor.get("/v1/audit", params={"project": "theirs"}).json()["items"]
    assert world.ids["upload_id"] in {entry["target"] for entry in entries}


def auditor_may(method: str, path: str) -> bool:
    return OPERATIONS[operation_at(method, path)] in ROLES["auditor"]


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
            assert case.send(holders[case.scope or "read"], method, path, world).is_success
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


# ---- comparing ----------------------------------------------------------------------------------------


def seen(answer: httpx.Response) -> tuple[int, dict[str, str], str]:
    """Everything that an answer tells, but for its moment, its turn, and the ids that the request named."""
    # Each request of a key leaves it one less, whatever it asks for.
    headers = {k: v for k, v in answer.headers.items() if k not in ("date", "x-correlation-id", "ratelimit")}
    text = re.sub(r"\b([a-z]{2,6})_[0-9a-z]{26}\b", r"\1", answer.text)
    return answer.status_code, headers, re.sub(r'"correlation_id":"\w+"', "", text)


def contents(database: Database) -> dict[str, list[Any]]:
    """All rows, but for the time at which a key was last used, and what the audit trail tells of refused requests."""
    found = {}
    with database.session() as session:
        for name, table in Base.metadata.tables.items():
            if name != "audit_head":
                query = sa.select(*(c for c in table.c if c.name not in ("last_used_at", *CHAIN)))
                query = query.where(table.c.kind == "change") if name == "audit" else query
                found[name] = sorted(session.execute(query).all(), key=str)
    return found


@contextmanager
def statements(database: Database) -> Iterator[list[str]]:
    """The statements that the database gets meanwhile, but for the look-up of keys."""
    found: list[str] = []

    def note(_: Any, __: Any, statement: str, *___: Any) -> None:
        others = threading.current_thread().name == "audit"
        if not others and "secret_hash" not in statement and "last_used_at" not in statement:
            found.append(statement)

    sa.event.listen(database.engine, "before_cursor_execute", note)
    try:
        yield found
    finally:
        sa.event.remove(database.engine, "before_cursor_execute", note)
