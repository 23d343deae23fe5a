"""Links that show one result to people without a key: what they show, what they do not, and how they end."""

from __future__ import annotations

import datetime
import sqlite3
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra.database import utc_now
from specimap_infra.tables import ApiKey, AuditEntry, Share, SignIn
from specimap_service.auth.dependencies import check_shared
from specimap_service.auth.keys import Principal
from specimap_service.auth.permissions import of_scopes
from specimap_service.clouds import share_routes
from specimap_service.contract.description import operations
from tests.support.access_scene import CASES, World, make_world
from tests.support.documented import check_refusal, contract
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving

COOKIE = "specimap_session"
END_SECONDS = 3.0
"""Within two seconds, and a moment for the machine."""
SHOWN = {
    "sessions.get",
    "sessions.delete",
    *("clouds.get", "clouds.get_cameras", "clouds.get_corners", "zarr.get", "zarr.head"),
    *("spectra.get_point", "spectra.get_band", "spectra.select"),
    *(f"previews.get_{name}" for name in ("rgb", "pca", "band", "composite", "index", "label")),
    *("labels.list", "labels.get", "labels.list_versions", "labels.get_values"),
    *("exports.get", "exports.list", "exports.get_content", "exports.head_content"),
}
"""All that a share permits, by operation."""


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database) as running:
        yield running


def browser(service: Running, **headers: str) -> httpx.Client:
    """A client that keeps cookies, and sends what the service's own pages send."""
    client = httpx.Client(
        base_url=service.url,
        headers={"Specimap-Page": "1", **headers},
        timeout=60,
        trust_env=False,
        verify=NO_TLS,
        event_hooks={"response": [check_refusal]},
    )
    service.clients.append(client)
    return client


def later(**time: float) -> str:
    return (utc_now() + datetime.timedelta(**time)).isoformat()


def share(client: httpx.Client, cloud_id: str, **given: Any) -> dict[str, Any]:
    """A new share."""
    answer = client.post(f"/v1/clouds/{cloud_id}/shares", json={"name": "board", "expires_at": later(days=7), **given})
    assert answer.status_code == 201, answer.text
    return dict(answer.json())


def opened(service: Running, token: str) -> httpx.Client:
    """A browser in which somebody has opened the link."""
    client = browser(service)
    answer = client.post("/v1/session", json={"share": token})
    assert answer.status_code == 201, answer.text
    return client


def code_of(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, answer.json()["code"]


def test_a_link_is_made_opened_listed_and_revoked(any_service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(any_service, tmp_path / "result").cloud_id
    maker = any_service.client(["upload", "read"])
    made = share(maker, cloud_id)
    token = made.pop("token")
    assert token.startswith(f"sps_{made['id'].removeprefix('shr_')}_")
    assert len(token.rsplit("_", 1)[1]) == 64
    assert (made["cloud_id"], made["name"], made["revoked_at"], made["last_used_at"]) == (cloud_id, "board", None, None)
    assert made["created_by"] == maker.get("/v1/session").json()["key_id"]
    assert maker.get(f"/v1/clouds/{cloud_id}/shares").json() == [made]

    guest = browser(any_service)
    answer = guest.post("/v1/session", json={"share": token})
    told = answer.json()
    assert answer.status_code == 201
    assert (told["key_id"], told["name"], told["scopes"], told["cloud_id"]) == (made["id"], "board", ["read"], cloud_id)
    assert guest.get("/v1/session").json() == told
    assert guest.get(f"/v1/clouds/{cloud_id}").json()["id"] == cloud_id
    (listed,) = maker.get(f"/v1/clouds/{cloud_id}/shares").json()
    assert listed["last_used_at"] is not None

    assert maker.delete(f"/v1/clouds/{cloud_id}/shares/{made['id']}").status_code == 204
    assert code_of(guest.get(f"/v1/clouds/{cloud_id}")) == (401, "unauthorized")
    assert code_of(browser(any_service).post("/v1/session", json={"share": token})) == (401, "unauthorized")
    (listed,) = maker.get(f"/v1/clouds/{cloud_id}/shares").json()
    assert listed["revoked_at"] is not None
    audited = any_service.client(["admin"]).get("/v1/audit", params={"target": made["id"]}).json()["items"]
    assert [(entry["action"], entry["key_id"], entry["details"]) for entry in reversed(audited)] == [
        ("share.create", made["created_by"], {"cloud": cloud_id}),
        ("share.open", made["id"], {"cloud": cloud_id}),
        ("share.revoke", made["created_by"], {"cloud": cloud_id}),
    ]


def test_every_operation_but_those_that_read_the_result_is_refused(any_service: Running, tmp_path: Path) -> None:
    project = any_service.project("theirs")
    holder = any_service.client(["upload", "read"], project=project)
    world = make_world(any_service, tmp_path / "result", project, holder)
    other = put_result(any_service, tmp_path / "other").cloud_id
    # Exports that somebody else has asked for are there to be read.
    guest = opened(any_service, share(holder, world.ids["cloud_id"])["token"])
    allowed = set()
    names = {(method.upper(), path): operation["operationId"] for method, path, operation in operations(contract())}
    for (method, path), case in CASES.items():
        if (method, path) == ("DELETE", "/v1/session"):
            continue
        answer = case.send(guest, method, path, world)
        name = names[method, path]
        if answer.is_success:
            allowed.add(name)
            assert answer.status_code == case.status, name
        else:
            assert answer.status_code == 403, f"{name}: {answer.status_code} {answer.text[:300]}"
            # Whether something exists makes no difference.
            absent = case.send(guest, method, path, world.absent())
            assert absent.status_code == 403
            if method != "HEAD":
                assert code_of(answer) == code_of(absent) == (403, "forbidden")
                assert answer.json()["details"] == {"cloud_id": world.ids["cloud_id"]}
    assert guest.delete("/v1/session").status_code == 204
    assert allowed | {"sessions.delete"} == SHOWN

    guest = opened(any_service, share(holder, world.ids["cloud_id"])["token"])
    elsewhere = World({**world.ids, "cloud_id": other}, world.spare, world.name, world.points)
    for (method, path), case in CASES.items():
        if "{cloud_id}" in path:
            assert case.send(guest, method, path, elsewhere).status_code == 403, f"{method} {path}"


CLOUD = f"cloud_{'0' * 26}"


@pytest.mark.parametrize(
    ("method", "path", "open"),
    [
        ("GET", f"/v1/clouds/{CLOUD}", True),
        ("HEAD", f"/v1/clouds/{CLOUD}/zarr/a/b", True),
        ("POST", f"/v1/clouds/{CLOUD}/spectra", True),
        ("POST", f"/v1/clouds/{CLOUD}/spectra/", False),
        ("POST", f"/v1/clouds/{CLOUD}/spectra/x", False),
        ("GET", f"/v1/clouds/{CLOUD}x", False),
        ("GET", f"/v1/clouds/{CLOUD[:-1]}", False),
        ("GET", f"/V1/clouds/{CLOUD}", False),
        ("GET", f"/v1/clouds//{CLOUD}", False),
        ("GET", f"/x/v1/clouds/{CLOUD}", False),
        ("GET", f"/v1/clouds/{CLOUD}/shares", False),
        ("GET", f"/v1/clouds/{CLOUD}/shares/", False),
        ("DELETE", f"/v1/clouds/{CLOUD}/shares/shr_1", False),
        ("OPTIONS", f"/v1/clouds/{CLOUD}", False),
        ("GET", "/v1/session/", False),
        ("GET", "/metrics", False),
    ],
)
def test_the_one_check_compares_whole_names(method: str, path: str, open: bool) -> None:
    guest = Principal("shr_1", ("prj_1",), of_scopes(["read"]), ("read",), 1, 1, "s", CLOUD)
    if open:
        check_shared(guest, method, path)
    else:
        with pytest.raises(PermissionError):
            check_shared(guest, method, path)


def test_lists_show_a_share_nothing_even_past_the_check(service: Running, tmp_path: Path) -> None:
    """What one forgotten path would show: the objects themselves are checked once more."""
    from specimap_infra.tables import Acquisition, CloudRow, Job
    from specimap_service.auth.access import Access, in_sight

    result, other = put_result(service, tmp_path / "result"), put_result(service, tmp_path / "other")
    project = service.client().get("/v1/session").json()["project_id"]
    guest = Principal("shr_1", (project,), of_scopes(["read"]), ("read",), 1, 1, "s", result.cloud_id)
    with service.database.session() as session:
        seen = {
            table: session.scalars(sa.select(table.id).where(in_sight(guest, table))).all()
            for table in (CloudRow, Job, Acquisition, ApiKey)
        }
    assert seen == {CloudRow: [result.cloud_id], Job: [], Acquisition: [], ApiKey: []}
    access = Access(service.database)
    assert access.is_known(guest, result.cloud_id)
    for object_id in (other.cloud_id, result.job_id, result.acquisition_id):
        assert not access.is_known(guest, object_id)
        with pytest.raises(FileNotFoundError):
            access.check(guest, object_id)


# ---- ends ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["revoked", "expired", "key revoked", "key expired", "cloud deleted"])
def test_sessions_of_a_share_end_with_it_within_seconds(any_service: Running, tmp_path: Path, how: str) -> None:
    result = put_result(any_service, tmp_path / "result")
    made = share(any_service.client(["upload", "read"]), result.cloud_id)
    guest = opened(any_service, made["token"])
    assert guest.get(f"/v1/clouds/{result.cloud_id}").status_code == 200
    if how == "cloud deleted":
        assert any_service.client(["admin"]).delete(f"/v1/jobs/{result.job_id}").status_code == 204
    else:
        # As another API process does it.
        table: Any = ApiKey if how.startswith("key") else Share
        wanted = made["created_by"] if how.startswith("key") else made["id"]
        values = {"revoked_at" if how.endswith("revoked") else "expires_at": utc_now()}
        with any_service.database.session() as session:
            session.execute(sa.update(table).where(table.id == wanted).values(**values))
    time.sleep(END_SECONDS)
    assert code_of(guest.get(f"/v1/clouds/{result.cloud_id}")) == (401, "unauthorized")
    assert code_of(browser(any_service).post("/v1/session", json={"share": made["token"]})) == (401, "unauthorized")
    # The browser that still holds the cookie signs in with a key.
    answer = guest.post("/v1/session", json={"key": any_service.key()})
    assert answer.status_code == 201, answer.text


def test_a_session_lasts_no_longer_than_its_share(service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    made = share(service.client(), cloud_id, expires_at=later(minutes=5))
    answer = browser(service).post("/v1/session", json={"share": made["token"]})
    assert answer.json()["expires_at"] == made["expires_at"]


def test_sessions_of_a_share_do_not_end_those_of_its_maker(
    any_service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("specimap_service.auth.sessions.MOST_SESSIONS", 2)
    cloud_id, key = put_result(any_service, tmp_path / "result").cloud_id, any_service.key()
    person = browser(any_service)
    assert person.post("/v1/session", json={"key": key}).status_code == 201
    token = share(person, cloud_id)["token"]
    guests = [opened(any_service, token) for _ in range(4)]
    assert person.get("/v1/jobs").status_code == 200
    assert [guest.get(f"/v1/clouds/{cloud_id}").status_code for guest in guests] == [401, 401, 200, 200]
    with any_service.database.session() as session:
        assert session.scalar(sa.select(sa.func.count()).select_from(SignIn)) == 3


def test_guests_have_a_rate_of_their_own(service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    maker = service.client(rate_per_minute=5)
    guest = opened(service, share(maker, cloud_id)["token"])
    codes = [guest.get("/v1/session").status_code for _ in range(6)]
    assert codes == [200] * 4 + [429] * 2
    assert maker.get("/v1/session").status_code == 200


# ---- making them --------------------------------------------------------------------------------------


def test_the_token_is_shown_once_and_hashed_at_rest(service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    client = service.client()
    token = share(client, cloud_id)["token"]
    assert token not in client.get(f"/v1/clouds/{cloud_id}/shares").text
    stored = sqlite3.connect(service.settings.data_dir / "specimap.db")
    lines = list(stored.iterdump())
    stored.close()
    assert all(token.rsplit("_", 1)[1] not in line for line in lines)


def test_a_share_is_no_key_and_a_key_no_share(service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    token, key = share(service.client(), cloud_id)["token"], service.key()
    for headers in ({"Authorization": f"Bearer {token}"}, {"Cookie": f"{COOKIE}={token}"}):
        assert browser(service, **headers).get(f"/v1/clouds/{cloud_id}").status_code == 401
    for body in ({"share": key}, {"key": token}, {"share": token[:-1] + ("0" if token[-1] != "0" else "1")}):
        answer = browser(service).post("/v1/session", json=body)
        assert code_of(answer) == (401, "unauthorized")
        assert "set-cookie" not in answer.headers
    for body in ({"share": token, "key": key}, {}, {"share": ""}):
        assert code_of(browser(service).post("/v1/session", json=body)) == (422, "request_invalid")


@pytest.mark.parametrize(
    ("given", "what"),
    [
        ({"expires_at": "2020-01-01T00:00:00Z"}, "the time has passed"),
        ({"expires_at": (utc_now() + datetime.timedelta(days=91)).isoformat()}, "more than 90 days from now"),
        ({"expires_at": "2026-11-30"}, None),
        ({"name": ""}, None),
        ({"name": "a\u202eb"}, None),
        ({"more": 1}, None),
    ],
)
def test_what_no_share_may_be_is_refused(
    service: Running, tmp_path: Path, given: dict[str, Any], what: str | None
) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    body = {"name": "board", "expires_at": later(days=1), **given}
    answer = service.client().post(f"/v1/clouds/{cloud_id}/shares", json=body)
    assert code_of(answer) == (422, "request_invalid")
    (field,) = answer.json()["details"]["fields"]
    assert field["where"] == f"body.{next(iter(given))}"
    assert what is None or field["what"] == what
    with service.database.session() as session:
        assert session.scalars(sa.select(Share.id)).all() == []


def test_a_result_has_a_bounded_number_of_valid_shares(
    service: Running, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(share_routes, "MOST_VALID", 2)
    cloud, maker = put_result(service, tmp_path / "result").cloud_id, service.client(["upload", "read"])
    expires = (utc_now() + datetime.timedelta(days=1)).isoformat()

    def made(name: str) -> httpx.Response:
        return maker.post(f"/v1/clouds/{cloud}/shares", json={"name": name, "expires_at": expires})

    first = made("a")
    assert (first.status_code, made("b").status_code) == (201, 201)
    refused = made("c")
    assert (refused.status_code, refused.json()["code"]) == (413, "quota_exceeded")
    assert maker.delete(f"/v1/clouds/{cloud}/shares/{first.json()['id']}").status_code == 204
    assert made("c").status_code == 201


def test_nobody_gives_what_their_key_does_not_have(service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    body = {"name": "board", "expires_at": later(days=1)}
    for scopes, lacking in ((["upload"], "read"), (["read", "label"], "upload")):
        answer = service.client(scopes).post(f"/v1/clouds/{cloud_id}/shares", json=body)
        assert code_of(answer) == (403, "forbidden")
        assert answer.json()["details"] == {"scope": lacking}


def test_a_share_is_looked_for_in_its_cloud_only(any_service: Running, tmp_path: Path) -> None:
    first, second = (put_result(any_service, tmp_path / name).cloud_id for name in ("first", "second"))
    client = any_service.client()
    made = share(client, first)
    assert client.get(f"/v1/clouds/{second}/shares").json() == []
    answer = client.delete(f"/v1/clouds/{second}/shares/{made['id']}")
    assert code_of(answer) == (404, "not_found")
    assert opened(any_service, made["token"]).get("/v1/session").status_code == 200


def test_opening_a_link_is_told_of_in_the_audit_trail_each_time(service: Running, tmp_path: Path) -> None:
    cloud_id = put_result(service, tmp_path / "result").cloud_id
    made = share(service.client(), cloud_id)
    for _ in range(3):
        opened(service, made["token"])
    with service.database.session() as session:
        told = session.scalars(sa.select(AuditEntry).where(AuditEntry.action == "share.open")).all()
    assert [(entry.target, entry.key_id) for entry in told] == [(made["id"], made["id"])] * 3
