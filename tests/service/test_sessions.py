"""People who sign in with a key: the cookie that stands for it, what it may do, and how it ends."""

from __future__ import annotations

import datetime
import re
import sqlite3
import threading
import time
from collections.abc import Iterator
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra.database import utc_now
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.tables import ApiKey, AuditEntry, SignIn
from specimap_service.auth import dependencies, sessions
from specimap_service.auth.sessions import session_id
from tests.support.documented import check_refusal
from tests.support.job_scene import queued_job
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import OCTETS, TUS, metadata, new_acquisition

COOKIE = "specimap_session"
PAGE = {"Specimap-Page": "1"}
END_SECONDS = 3.0
"""Within two seconds, and a moment for the machine."""


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database) as running:
        yield running


def browser(service: Running, **headers: str) -> httpx.Client:
    """A client that keeps cookies, and sends what the service's own pages send."""
    client = httpx.Client(
        base_url=service.url,
        headers={**PAGE, **headers},
        timeout=60,
        trust_env=False,
        verify=NO_TLS,
        event_hooks={"response": [check_refusal]},
    )
    service.clients.append(client)
    return client


def signed_in(service: Running, key: str) -> httpx.Client:
    client = browser(service)
    answer = client.post("/v1/session", json={"key": key})
    assert answer.status_code == 201, answer.text
    return client


def cookie_of(answer: httpx.Response) -> Any:
    return SimpleCookie(answer.headers["set-cookie"])[COOKIE]


def code_of(answer: httpx.Response) -> tuple[int, str]:
    return answer.status_code, answer.json()["code"]


def key_id_of(key: str) -> str:
    return f"key_{key.split('_')[1]}"


def revoke(service: Running, key: str) -> None:
    """As another program does, of which this service learns from the database alone."""
    with service.database.session() as session:
        session.execute(sa.update(ApiKey).where(ApiKey.id == key_id_of(key)).values(revoked_at=utc_now()))


def count(service: Running) -> int:
    with service.database.session() as session:
        return session.scalar(sa.select(sa.func.count()).select_from(SignIn)) or 0


# ---- signing in and out -------------------------------------------------------------------------------


def test_a_person_signs_in_looks_and_signs_out(any_service: Running) -> None:
    key = any_service.key(["read", "upload"])
    client = browser(any_service)
    answer = client.post("/v1/session", json={"key": key})
    told = answer.json()
    assert (answer.status_code, answer.headers["cache-control"]) == (201, "no-store")
    end = datetime.datetime.fromisoformat(told.pop("expires_at"))
    assert abs((end - utc_now()).total_seconds() - 12 * 3600) < 60
    assert told == {
        "key_id": key_id_of(key),
        "name": "test",
        "project_id": DEFAULT_PROJECT,
        "project": "default",
        "projects": [{"id": DEFAULT_PROJECT, "name": "default"}],
        "scopes": ["upload", "read"],
        "roles": [],
        "permissions": ["capture.write", "job.run", "result.read", "result.send", "share.manage", "study.manage"],
        "cloud_id": None,
    }
    cookie = cookie_of(answer)
    assert (cookie["httponly"], cookie["samesite"], cookie["path"], cookie["domain"]) == (True, "strict", "/", "")
    assert cookie["secure"] == ""
    assert 12 * 3600 - 60 < int(cookie["max-age"]) <= 12 * 3600
    assert len(cookie.value) >= 43, "256 bits"
    assert client.get("/v1/session").json() == answer.json()
    assert client.get("/v1/jobs").status_code == 200
    assert new_acquisition(client).startswith("acq_")
    assert code_of(client.get("/v1/keys")) == (403, "forbidden")

    left = client.delete("/v1/session")
    assert (left.status_code, cookie_of(left)["max-age"], cookie_of(left).value) == (204, "0", "")
    assert COOKIE not in client.cookies
    assert count(any_service) == 0
    stolen = browser(any_service, Cookie=f"{COOKIE}={cookie.value}")
    assert code_of(stolen.get("/v1/jobs")) == (401, "unauthorized")
    with any_service.database.session() as session:
        found = session.execute(
            sa.select(AuditEntry.action, AuditEntry.key_id, AuditEntry.target).order_by(AuditEntry.id)
        )
        told_of = [tuple(row) for row in found if row.action.startswith("session.")]
    assert told_of == [(f"session.{what}", key_id_of(key), key_id_of(key)) for what in ("create", "delete")]


def test_neither_token_nor_key_is_stored(service: Running) -> None:
    key = service.key(["read"])
    token = signed_in(service, key).cookies[COOKIE]
    stored = sqlite3.connect(service.settings.data_dir / "specimap.db")
    lines = list(stored.iterdump())
    stored.close()
    assert any(session_id(token) in line for line in lines)
    assert all(token not in line and key.rsplit("_", 1)[1] not in line for line in lines)


def test_a_key_is_told_about_itself(service: Running) -> None:
    client = service.client(["read"])
    told = client.get("/v1/session").json()
    assert (told["scopes"], told["expires_at"], told["cloud_id"]) == (["read"], None, None)
    assert client.delete("/v1/session").status_code == 204
    assert client.get("/v1/session").status_code == 200


def test_signing_in_again_ends_the_session_before(service: Running) -> None:
    client = signed_in(service, service.key(["read"]))
    first = client.cookies[COOKIE]
    other = service.key(["read"])
    assert client.post("/v1/session", json={"key": other}).json()["key_id"] == key_id_of(other)
    assert count(service) == 1
    assert client.cookies[COOKIE] != first
    assert client.get("/v1/session").json()["key_id"] == key_id_of(other)


@pytest.mark.parametrize(
    ("settings", "headers", "secure"),
    [
        ({}, {}, False),
        ({}, {"X-Forwarded-Proto": "http"}, False),
        ({}, {"X-Forwarded-Proto": "https"}, True),
        ({"public_url": "http://specimap.example"}, {}, False),
        ({"public_url": "https://specimap.example/base/"}, {}, True),
    ],
)
def test_cookie_is_secure_where_the_browser_speaks_tls(
    tmp_path: Path, settings: dict[str, Any], headers: dict[str, str], secure: bool
) -> None:
    with serving(tmp_path, **settings) as service:
        answer = browser(service).post("/v1/session", json={"key": service.key()}, headers=headers)
        assert bool(cookie_of(answer)["secure"]) == secure


@pytest.mark.parametrize(
    "wrong", ["x", "spk_", "spk_x_y", f"spk_{'0' * 26}_{'0' * 64}", "sps_" + "0" * 26 + "_" + "0" * 64]
)
def test_wrong_keys_are_refused_alike(service: Running, wrong: str) -> None:
    answer = browser(service).post("/v1/session", json={"key": wrong})
    assert code_of(answer) == (401, "unauthorized")
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize("body", [b"", b"{", b"{}", b'{"key": 1}', b'{"key": "a\\u0000b"}', b'{"key": "x", "more": 1}'])
def test_what_is_no_key_is_refused_without_an_echo(service: Running, body: bytes) -> None:
    answer = browser(service).post("/v1/session", content=body, headers={"Content-Type": "application/json"})
    assert code_of(answer) == (422, "request_invalid")


def test_sign_in_reads_little_without_a_key(service: Running) -> None:
    long = browser(service).post("/v1/session", json={"key": "x" * 5000})
    assert code_of(long) == (413, "payload_too_large")


def test_wrong_keys_and_tokens_of_an_address_are_limited(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dependencies, "FAILURES_PER_MINUTE", 4)
    client = browser(service)
    right = service.key()
    codes = [client.post("/v1/session", json={"key": "spk_x_y"}).status_code for _ in range(3)]
    stolen = browser(service, Cookie=f"{COOKIE}=guessed")
    codes += [stolen.get("/v1/session").status_code for _ in range(3)]
    assert codes == [401] * 4 + [429] * 2
    late = client.post("/v1/session", json={"key": "spk_x_y"})
    assert code_of(late) == (429, "rate_limited")
    assert int(late.headers["retry-after"]) >= 1
    # Whoever shares the address may still come in.
    assert client.post("/v1/session", json={"key": right}).status_code == 201


def test_sessions_share_the_rate_of_their_key(service: Running) -> None:
    key = service.key(["read"], rate_per_minute=6)
    clients = [signed_in(service, key), signed_in(service, key)]
    codes = [client.get("/v1/session").status_code for client in clients * 3]
    assert codes == [200] * 4 + [429] * 2


# ---- ends ---------------------------------------------------------------------------------------------


def test_session_expires_as_the_setting_says(tmp_path: Path) -> None:
    with serving(tmp_path, session_hours=2 / 3600) as service:
        client = signed_in(service, service.key(["read"]))
        token = client.cookies[COOKIE]
        assert client.get("/v1/jobs").status_code == 200
        client.cookies.set(COOKIE, token)
        time.sleep(2 + END_SECONDS)
        # As one who keeps the cookie longer than the browser would.
        held = browser(service, Cookie=f"{COOKIE}={token}")
        assert code_of(held.get("/v1/jobs")) == (401, "unauthorized")


def test_session_ends_no_later_than_its_key(service: Running) -> None:
    key = service.key(["read"])
    end = (utc_now() + datetime.timedelta(minutes=5)).replace(microsecond=0)
    with service.database.session() as session:
        session.execute(sa.update(ApiKey).where(ApiKey.id == key_id_of(key)).values(expires_at=end))
    answer = browser(service).post("/v1/session", json={"key": key})
    assert datetime.datetime.fromisoformat(answer.json()["expires_at"]) == end
    assert 200 < int(cookie_of(answer)["max-age"]) <= 300


def test_session_ends_with_its_key_within_seconds(any_service: Running) -> None:
    key = any_service.key(["read"])
    client = signed_in(any_service, key)
    assert client.get("/v1/jobs").status_code == 200
    revoke(any_service, key)
    time.sleep(END_SECONDS)
    assert code_of(client.get("/v1/jobs")) == (401, "unauthorized")
    assert code_of(client.post("/v1/session", json={"key": key})) == (401, "unauthorized")


@pytest.mark.parametrize("how", ["sign out", "revoke"])
def test_event_stream_takes_the_cookie_and_ends_with_the_session(any_service: Running, how: str) -> None:
    job_id, key = queued_job(any_service.database), any_service.key(["read"])
    client = signed_in(any_service, key)
    # EventSource sends no header of the page's own.
    stream = browser(any_service, Cookie=f"{COOKIE}={client.cookies[COOKIE]}")
    del stream.headers["Specimap-Page"]
    lines: list[str] = []

    def follow() -> None:
        with stream.stream("GET", f"/v1/jobs/{job_id}/events") as answer:
            for line in answer.iter_lines():
                lines.append(line)

    thread = threading.Thread(target=follow)
    thread.start()
    end = time.monotonic() + 30
    while "event: state" not in lines:
        assert thread.is_alive(), lines
        assert time.monotonic() < end
        time.sleep(0.05)
    if how == "revoke":
        revoke(any_service, key)
    else:
        assert client.delete("/v1/session").status_code == 204
    thread.join(timeout=END_SECONDS + 2)
    assert not thread.is_alive()


def test_oldest_session_of_a_key_goes_when_there_are_too_many(
    any_service: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sessions, "MOST_SESSIONS", 3)
    key = any_service.key(["read"])
    other = signed_in(any_service, any_service.key(["read"]))
    clients = [signed_in(any_service, key) for _ in range(5)]
    assert count(any_service) == 4
    assert [client.get("/v1/jobs").status_code for client in clients] == [401, 401, 200, 200, 200]
    assert other.get("/v1/jobs").status_code == 200


# ---- other sites --------------------------------------------------------------------------------------

WRITES = [
    ("POST", "/v1/acquisitions", {"json": {"specimen_id": "S-9"}}),
    ("DELETE", "/v1/session", {}),
    ("PUT", f"/v1/clouds/cloud_{'0' * 26}/labels/x", {"content": b"x"}),
    ("PATCH", f"/v1/uploads/up_{'0' * 26}", {"content": b"x"}),
]


@pytest.mark.parametrize(("method", "path", "given"), WRITES)
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Specimap-Page": "0"},
        {**PAGE, "Sec-Fetch-Site": "cross-site"},
        {**PAGE, "Sec-Fetch-Site": "same-site"},
        {**PAGE, "Sec-Fetch-Site": "none"},
        {"Sec-Fetch-Site": "same-origin"},
    ],
)
def test_changes_are_taken_from_own_pages_only(
    service: Running, method: str, path: str, given: dict[str, Any], headers: dict[str, str]
) -> None:
    client = signed_in(service, service.key())
    del client.headers["Specimap-Page"]
    before = count(service)
    refused = client.request(method, path, headers=headers, **given)
    assert code_of(refused) == (403, "cross_site_request")
    assert count(service) == before
    assert client.get("/v1/acquisitions").json()["items"] == []
    taken = client.request(method, path, headers={**PAGE, "Sec-Fetch-Site": "same-origin"}, **given)
    assert taken.status_code != 403


@pytest.mark.parametrize(
    ("site", "status"), [("same-origin", 200), ("none", 200), ("same-site", 403), ("cross-site", 403)]
)
def test_other_sites_read_nothing(service: Running, site: str, status: int) -> None:
    client = signed_in(service, service.key())
    del client.headers["Specimap-Page"]
    for method in ("GET", "HEAD"):
        assert client.request(method, "/v1/jobs", headers={"Sec-Fetch-Site": site}).status_code == status


@pytest.mark.parametrize("headers", [{}, {**PAGE, "Sec-Fetch-Site": "cross-site"}])
def test_no_other_site_signs_a_person_in(service: Running, headers: dict[str, str]) -> None:
    client = browser(service)
    del client.headers["Specimap-Page"]
    answer = client.post("/v1/session", json={"key": service.key()}, headers=headers)
    assert code_of(answer) == (403, "cross_site_request")
    assert "set-cookie" not in answer.headers
    assert count(service) == 0


def test_allowed_origins_get_no_answers_to_cookies(tmp_path: Path) -> None:
    origin = {"Origin": "https://viewer.example"}
    with serving(tmp_path, cors_origins=["https://viewer.example"]) as service:
        client = signed_in(service, service.key())
        asked = {**origin, "Access-Control-Request-Method": "POST", "Access-Control-Request-Headers": "specimap-page"}
        # A browser sends no cookie, nor lets a page read an answer to one, without this header.
        for answer in (client.options("/v1/jobs", headers=asked), client.get("/v1/jobs", headers=origin)):
            assert answer.headers["access-control-allow-origin"] == "https://viewer.example"
            assert "access-control-allow-credentials" not in answer.headers
        crossed = client.get("/v1/jobs", headers={**origin, "Sec-Fetch-Site": "cross-site"})
        assert crossed.status_code == 403


def test_a_key_counts_before_the_cookie_and_takes_no_header(service: Running) -> None:
    client = signed_in(service, service.key(["read"]))
    del client.headers["Specimap-Page"]
    key = service.key(["upload"])
    bearer = {"Authorization": f"Bearer {key}", "Sec-Fetch-Site": "cross-site"}
    assert client.get("/v1/session", headers=bearer).json()["key_id"] == key_id_of(key)
    made = client.post("/v1/acquisitions", json={"specimen_id": "S-1"}, headers=bearer)
    assert made.status_code == 201
    # A wrong one is not made good by the cookie.
    for wrong in ("Bearer spk_x_y", "Basic eDp5", ""):
        assert client.get("/v1/jobs", headers={"Authorization": wrong}).status_code == 401


def test_a_token_is_no_key_and_a_key_no_token(service: Running) -> None:
    key = service.key()
    token = signed_in(service, key).cookies[COOKIE]
    assert browser(service, Authorization=f"Bearer {token}").get("/v1/jobs").status_code == 401
    assert browser(service, Cookie=f"{COOKIE}={key}").get("/v1/jobs").status_code == 401


# ---- what sessions do ---------------------------------------------------------------------------------


def test_uploads_go_on_with_the_cookie(any_service: Running) -> None:
    key = any_service.key()
    client = signed_in(any_service, key)
    acquisition = new_acquisition(client)
    fields = metadata(acquisition=acquisition, role="photo", filename="a.jpg")
    created = client.post("/v1/uploads", headers={**TUS, "Upload-Length": "3", "Upload-Metadata": fields})
    assert created.status_code == 201, created.text
    address = re.sub("^.*(?=/v1/)", "", created.headers["location"])
    head = client.head(address, headers=TUS)
    assert head.headers["upload-offset"] == "0"
    # Another session of the same key continues.
    other = signed_in(any_service, key)
    sent = other.patch(address, content=b"abc", headers={**TUS, "Upload-Offset": "0", "Content-Type": OCTETS})
    assert (sent.status_code, sent.headers["upload-offset"]) == (204, "3")
    assert client.get(f"{address}/result").json()["state"] == "finished"


def test_a_key_that_a_session_makes_is_shown_again_to_that_session_only(any_service: Running) -> None:
    key = any_service.key()
    client = signed_in(any_service, key)
    asked: dict[str, Any] = {"json": {"name": "tablet", "scopes": ["read"]}, "headers": {"Idempotency-Key": "once"}}
    made, again = client.post("/v1/keys", **asked), client.post("/v1/keys", **asked)
    assert (made.status_code, again.status_code) == (201, 200)
    assert made.json() == again.json()
    assert browser(any_service, Authorization=f"Bearer {made.json()['key']}").get("/v1/jobs").status_code == 200
    bearer = browser(any_service, Authorization=f"Bearer {key}")
    for other in (signed_in(any_service, key), bearer):
        refused = other.post("/v1/keys", **asked)
        assert code_of(refused) == (409, "idempotency_conflict")
        assert refused.json()["details"] == {"key_id": made.json()["id"]}
        assert made.json()["key"] not in refused.text


def test_what_a_session_makes_is_its_keys(service: Running) -> None:
    key = service.key()
    acquisition = new_acquisition(signed_in(service, key))
    with service.database.session() as session:
        made_by = session.scalars(sa.select(AuditEntry.key_id).where(AuditEntry.target == acquisition)).all()
    assert made_by == [key_id_of(key)]
