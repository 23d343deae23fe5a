"""The sign-in with an identity provider on the pages: how it goes, what keeps it from being abused, how it ends."""

from __future__ import annotations

import datetime
import logging
import socket
from collections.abc import Iterator
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra.database import utc_now
from specimap_infra.tables import AuditEntry, Person, SignIn, SignInAttempt
from specimap_service.auth.oidc.provider import FRESH_SECONDS
from specimap_service.auth.oidc.sign_in import ATTEMPT_MINUTES
from specimap_service.auth.sessions import session_id
from tests.support.documented import check_refusal
from tests.support.identity_provider import Provider, browser, provider_running
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import new_acquisition


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def provider() -> Iterator[Provider]:
    with provider_running() as running:
        yield running


@pytest.fixture
def service(provider: Provider, tmp_path: Path) -> Iterator[Running]:
    port = free_port()
    settings = provider.settings(f"http://127.0.0.1:{port}")
    with serving(tmp_path / "service", bound=port, **settings) as running:
        yield running


def client_of(service: Running) -> httpx.Client:
    client = browser(service.url)
    client.event_hooks = {"response": [check_refusal]}
    service.clients.append(client)
    return client


def at_provider(address: str) -> str:
    """Where the provider sends the browser back to."""
    answer = httpx.get(address, trust_env=False)
    assert answer.status_code == 302, answer.text
    return answer.headers["location"]


def signed_in(service: Running, client: httpx.Client, **params: str) -> httpx.Response:
    """Go the whole way; return the last answer of the service."""
    begun = client.get("/v1/sso/login", params=params)
    assert begun.status_code == 303, begun.text
    return client.get(at_provider(begun.headers["location"]))


def reason_of(service: Running, answer: httpx.Response) -> str:
    """The reason with which the service sends a browser back to its sign-in page."""
    assert answer.status_code == 303
    assert "specimap_session" not in answer.headers.get("set-cookie", "")
    base, _, fragment = answer.headers["location"].partition("#/?sso=")
    assert base == f"{service.url}/"
    return str(fragment)


# ---- the way ------------------------------------------------------------------------------------------


def test_a_person_signs_in_works_and_signs_out(service: Running, provider: Provider) -> None:
    client = client_of(service)
    assert client.get("/v1/sso").json() == {"enabled": True, "name": ""}
    begun = client.get("/v1/sso/login", params={"return_to": "/view/cloud_1?band=3"})
    asked = {name: values[0] for name, values in parse_qs(urlsplit(begun.headers["location"]).query).items()}
    assert begun.headers["location"].startswith(f"{provider.issuer}/authorize?")
    assert (asked["response_type"], asked["client_id"], asked["scope"]) == ("code", "specimap", "openid")
    assert (asked["code_challenge_method"], asked["redirect_uri"]) == ("S256", f"{service.url}/v1/sso/callback")
    assert min(len(asked[name]) for name in ("state", "nonce", "code_challenge")) >= 43
    attempt = SimpleCookie(begun.headers["set-cookie"])["specimap_sign_in"]
    assert (attempt["httponly"], attempt["samesite"]) == (True, "lax")

    ended = client.get(at_provider(begun.headers["location"]))
    assert (ended.status_code, ended.headers["location"]) == (303, f"{service.url}/#/view/cloud_1?band=3")
    assert (ended.headers["cache-control"], ended.headers["referrer-policy"]) == ("no-store", "no-referrer")
    cookies = [SimpleCookie(text) for text in ended.headers.get_list("set-cookie")]
    session = next(cookie["specimap_session"] for cookie in cookies if "specimap_session" in cookie)
    assert (session["httponly"], session["samesite"], session["path"]) == (True, "strict", "/")
    told = client.get("/v1/session").json()
    assert (told["roles"], told["cloud_id"]) == (["technician"], None)
    assert told["name"] == f"person {told['key_id'][-6:]}"
    assert "alice" not in str(told)
    end = datetime.datetime.fromisoformat(told["expires_at"])
    assert abs((end - utc_now()).total_seconds() - 12 * 3600) < 60
    assert new_acquisition(client).startswith("acq_")
    assert client.get("/v1/keys").status_code == 403

    left = client.post("/v1/sso/logout")
    address = urlsplit(left.json()["end_session_url"])
    given = parse_qs(address.query)
    assert f"{address.scheme}://{address.netloc}{address.path}" == f"{provider.issuer}/end"
    assert given["post_logout_redirect_uri"] == [f"{service.url}/"]
    assert given["client_id"] == ["specimap"]
    assert given["id_token_hint"][0].count(".") == 2
    assert client.get("/v1/session").status_code == 401
    with service.database.session() as rows:
        changes = sa.select(AuditEntry).where(AuditEntry.kind == "change", AuditEntry.action != "service.start")
        entries = list(rows.scalars(changes.order_by(AuditEntry.id)))
        assert [entry.action for entry in entries] == ["session.create", "acquisition.create", "session.delete"]
        assert {entry.key_id for entry in entries} == {told["key_id"]}
        assert entries[0].details == {"roles": ["technician"]}
        assert rows.scalar(sa.select(sa.func.count()).select_from(SignInAttempt)) == 0


def test_the_same_person_has_the_same_pseudonym_and_another_has_another(service: Running, provider: Provider) -> None:
    def known() -> str:
        client = client_of(service)
        signed_in(service, client)
        return str(client.get("/v1/session").json()["key_id"])

    first = known()
    assert known() == first
    provider.account = {"sub": "bob", "roles": ["specimap-clinician"]}
    assert known() != first


def test_nothing_of_a_person_is_kept_or_logged(
    service: Running, provider: Provider, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.DEBUG)
    provider.account |= {"sub": "very-own-subject", "name": "Doe^Jane", "email": "jane@example.test"}
    signed_in(service, client_of(service))
    provider.account["roles"] = []
    signed_in(service, client_of(service))
    out = "".join(capfd.readouterr()) + caplog.text
    with service.database.session() as session:
        stored = str(
            [
                session.execute(sa.select(table)).all()
                for table in (Person.__table__, SignIn.__table__, AuditEntry.__table__)
            ]
        )
    for name in ("very-own-subject", "Doe^Jane", "jane@"):
        assert name not in out
        assert name not in stored


def test_roles_of_userinfo_count_where_the_id_token_has_none(service: Running, provider: Provider) -> None:
    provider.account = {"sub": "alice"}
    provider.userinfo = {"roles": ["specimap-auditor"]}
    client = client_of(service)
    signed_in(service, client)
    assert client.get("/v1/session").json()["roles"] == ["auditor"]
    # Not those of another account.
    provider.userinfo = {"sub": "mallory", "roles": ["specimap-admin"]}
    assert reason_of(service, signed_in(service, client_of(service))) == "no_role"


def test_without_a_provider_there_is_no_such_sign_in(tmp_path: Path) -> None:
    with serving(tmp_path) as plain:
        client = client_of(plain)
        assert client.get("/v1/sso").json() == {"enabled": False, "name": ""}
        for path in ("/v1/sso/login", "/v1/sso/callback"):
            answer = client.get(path)
            assert (answer.status_code, answer.json()["code"]) == (404, "sign_in_not_configured")


def test_a_key_signs_in_and_out_beside_a_provider(service: Running) -> None:
    client = client_of(service)
    assert client.post("/v1/session", json={"key": service.key(["read"])}).status_code == 201
    assert client.post("/v1/sso/logout").json() == {"end_session_url": None}
    assert client.get("/v1/session").status_code == 401


# ---- abuse --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wanted",
    [
        "https://evil.test/",
        "//evil.test",
        "/\\evil.test",
        "\\\\evil.test",
        "javascript:alert(1)",
        "/x\r\nLocation: y",
        "@evil.test",
    ],
)
def test_nobody_is_sent_elsewhere(service: Running, wanted: str) -> None:
    ended = signed_in(service, client_of(service), return_to=wanted)
    target = urlsplit(ended.headers["location"])
    assert f"{target.scheme}://{target.netloc}{target.path}" == f"{service.url}/"


def test_the_host_that_a_request_names_does_not_count(service: Running) -> None:
    client = client_of(service)
    begun = client.get("/v1/sso/login", headers={"Host": "evil.test", "X-Forwarded-Host": "evil.test"})
    asked = parse_qs(urlsplit(begun.headers["location"]).query)
    assert asked["redirect_uri"] == [f"{service.url}/v1/sso/callback"]


def test_behind_tls_cookies_are_of_this_host_alone(service: Running) -> None:
    begun = client_of(service).get("/v1/sso/login", headers={"X-Forwarded-Proto": "https"})
    (cookie,) = SimpleCookie(begun.headers["set-cookie"]).values()
    assert cookie.key == "__Host-specimap_sign_in"
    assert (cookie["secure"], cookie["path"], cookie["domain"]) == (True, "/", "")


def test_an_answer_counts_in_the_browser_that_asked_alone(service: Running, provider: Provider) -> None:
    attacker, victim = client_of(service), client_of(service)
    back = at_provider(attacker.get("/v1/sso/login").headers["location"])
    # The attacker's answer, in the victim's browser, with and without a sign-in of its own under way.
    assert reason_of(service, victim.get(back)) == "other_browser"
    victim.get("/v1/sso/login")
    assert reason_of(service, victim.get(back)) == "other_browser"
    assert victim.get("/v1/session").status_code == 401


def test_an_answer_counts_once(service: Running) -> None:
    client = client_of(service)
    begun = client.get("/v1/sso/login")
    cookie = client.cookies["specimap_sign_in"]
    back = at_provider(begun.headers["location"])
    assert client.get(back).headers["location"] == f"{service.url}/#/"
    again = browser(service.url, Cookie=f"specimap_sign_in={cookie}")
    assert reason_of(service, again.get(back)) == "attempt_unknown"
    again.close()


def test_an_answer_that_comes_late_does_not_count(service: Running) -> None:
    client = client_of(service)
    back = at_provider(client.get("/v1/sso/login").headers["location"])
    with service.database.session() as session:
        past = utc_now() - datetime.timedelta(minutes=ATTEMPT_MINUTES)
        session.execute(sa.update(SignInAttempt).values(expires_at=past))
    assert reason_of(service, client.get(back)) == "attempt_unknown"


def test_made_up_answers_do_not_count(service: Running) -> None:
    client = client_of(service)
    assert reason_of(service, client.get("/v1/sso/callback")) == "attempt_unknown"
    assert reason_of(service, client.get("/v1/sso/callback", params={"state": "x", "code": "y"})) == "attempt_unknown"
    begun = client.get("/v1/sso/login")
    state = parse_qs(urlsplit(begun.headers["location"]).query)["state"][0]
    twice = client.get(f"/v1/sso/callback?state={state}&code=a&code=b")
    assert (twice.status_code, twice.json()["code"]) == (422, "request_invalid")
    assert reason_of(service, client.get("/v1/sso/callback", params={"state": state, "code": "y"})) == "code_refused"


def test_another_sites_page_begins_no_sign_in(service: Running) -> None:
    client = client_of(service)
    answer = client.get("/v1/sso/login", headers={"Sec-Fetch-Site": "cross-site"})
    assert (answer.status_code, answer.json()["code"]) == (403, "cross_site_request")
    assert client.get("/v1/sso/login", headers={"Sec-Fetch-Site": "same-origin"}).status_code == 303


def test_another_providers_answer_does_not_count(service: Running, provider: Provider) -> None:
    provider.answer = {"iss": "https://mallory.test"}
    assert reason_of(service, signed_in(service, client_of(service))) == "other_issuer"
    provider.answer = {"iss": provider.issuer, "session_state": "of its own"}
    assert signed_in(service, client_of(service)).headers["location"] == f"{service.url}/#/"
    # One that says its name always must do so.
    provider.answer, provider.metadata = {}, {"authorization_response_iss_parameter_supported": True}
    service.app.state.identity.provider._known = None
    service.app.state.identity.provider._tried = None
    assert reason_of(service, signed_in(service, client_of(service))) == "other_issuer"


@pytest.mark.parametrize(
    "claims",
    [
        {"nonce": "another"},
        {"nonce": None},
        {"aud": "another"},
        {"aud": ["specimap", "another"]},
        {"azp": "another"},
        {"iss": "https://mallory.test"},
        {"exp": 1},
        {"iat": None},
        {"at_hash": "wrong"},
    ],
)
def test_id_tokens_that_are_not_of_this_sign_in(service: Running, provider: Provider, claims: dict[str, Any]) -> None:
    provider.id_token = claims
    assert reason_of(service, signed_in(service, client_of(service))) == "token_invalid"


def test_a_session_is_new_and_ends_the_one_before(service: Running, provider: Provider) -> None:
    client = client_of(service)
    client.cookies.set("specimap_session", "fixed-by-somebody", domain="127.0.0.1", path="/")
    signed_in(service, client)
    first = client.cookies.get("specimap_session", domain="127.0.0.1")
    assert first is not None
    assert first != "fixed-by-somebody"
    assert len(first) >= 43
    signed_in(service, client)
    with service.database.session() as session:
        assert session.get(SignIn, session_id(first)) is None
        assert session.scalar(sa.select(sa.func.count()).select_from(SignIn)) == 1


# ---- refusals -----------------------------------------------------------------------------------------


def test_who_has_no_role_does_not_come_in(service: Running, provider: Provider) -> None:
    provider.account["roles"] = ["something-else"]
    assert reason_of(service, signed_in(service, client_of(service))) == "no_role"
    with service.database.session() as session:
        assert session.scalar(sa.select(sa.func.count()).select_from(SignIn)) == 0


def test_a_provider_that_refuses_is_believed(service: Running, provider: Provider) -> None:
    provider.answer = {"code": "", "error": "access_denied"}
    assert reason_of(service, signed_in(service, client_of(service))) == "provider_refused"


def test_a_blocked_person_is_out_at_once(service: Running, provider: Provider) -> None:
    client = client_of(service)
    signed_in(service, client)
    person = client.get("/v1/session").json()["key_id"]
    with service.database.session() as session:
        session.get_one(Person, person).blocked_at = utc_now()
    service.app.state.keyring.forget()
    assert client.get("/v1/session").status_code == 401
    assert client.get("/v1/jobs", headers={"Authorization": f"Bearer {provider.token()}"}).status_code == 401
    assert reason_of(service, signed_in(service, client_of(service))) == "blocked"


def test_while_the_provider_is_away_sessions_and_keys_go_on(service: Running, provider: Provider) -> None:
    client = client_of(service)
    signed_in(service, client)
    provider.away = True
    known = service.app.state.identity.provider
    known._clock = lambda: FRESH_SECONDS * 10_000
    assert client.get("/v1/jobs").status_code == 200
    assert service.client(["read"]).get("/v1/jobs").status_code == 200
    stranger = client_of(service)
    answer = stranger.get("/v1/sso/login")
    assert reason_of(service, answer) == "identity_unavailable"
    assert client.post("/v1/sso/logout").json() == {"end_session_url": None}
    assert client.get("/v1/session").status_code == 401


# ---- projects by group --------------------------------------------------------------------------------


def test_groups_give_projects(provider: Provider, tmp_path: Path) -> None:
    port = free_port()
    settings = provider.settings(
        f"http://127.0.0.1:{port}",
        oidc_projects_claim="department.groups",
        oidc_projects={"ward-1": "breast", "ward-2": "skin", "ward-3": "not-there"},
    )
    with serving(tmp_path / "service", bound=port, **settings) as service:
        breast, skin = service.project("breast"), service.project("skin")
        theirs = {
            project: new_acquisition(service.client(["upload", "read"], project=project)) for project in (breast, skin)
        }

        def seen(*groups: str) -> tuple[httpx.Client, list[str]]:
            provider.account["department"] = {"groups": list(groups)}
            client = client_of(service)
            signed_in(service, client)
            return client, [item["id"] for item in client.get("/v1/acquisitions").json()["items"]]

        assert seen("ward-1", "unknown")[1] == [theirs[breast]]
        both, listed = seen("ward-1", "ward-2", "ward-3")
        assert listed == sorted(theirs.values(), reverse=True)
        assert both.get("/v1/acquisitions", params={"project": "skin"}).json()["items"][0]["id"] == theirs[skin]
        assert {project["name"] for project in both.get("/v1/projects").json()} == {"breast", "skin"}
        unnamed = both.post("/v1/acquisitions", json={"specimen_id": "S-2"})
        assert (unnamed.status_code, unnamed.json()["details"]["projects"]) == (422, sorted([breast, skin]))
        made = both.post("/v1/acquisitions", json={"specimen_id": "S-2", "project": "skin"})
        assert (made.status_code, made.json()["project_id"]) == (201, skin)
        assert both.post("/v1/acquisitions", json={"specimen_id": "S-2", "project": "default"}).status_code == 404
        one, _ = seen("ward-1")
        assert one.get(f"/v1/acquisitions/{theirs[skin]}").status_code == 404
        assert one.post("/v1/acquisitions", json={"specimen_id": "S-3"}).json()["project_id"] == breast
        none, listed = seen()
        assert (listed, none.get("/v1/session").json()["project_id"]) == ([], "")
        refused = none.post("/v1/acquisitions", json={"specimen_id": "S-4"})
        assert (refused.status_code, refused.json()["code"]) == (403, "forbidden")


def test_groups_make_projects_where_the_settings_say_so(provider: Provider, tmp_path: Path) -> None:
    port = free_port()
    settings = provider.settings(f"http://127.0.0.1:{port}", oidc_projects_claim="groups", oidc_create_projects=True)
    with serving(tmp_path / "service", bound=port, **settings) as service:
        provider.account["groups"] = ["ward-9", "no name of a project"]
        for _ in range(2):
            client = client_of(service)
            signed_in(service, client)
            assert [project["name"] for project in client.get("/v1/session").json()["projects"]] == ["ward-9"]
