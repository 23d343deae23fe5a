"""Keys, scopes, rates, the audit trail, errors as problems, health and metrics."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra.database import utc_now
from specimap_infra.tables import ApiKey
from specimap_service.auth.rate_limit import RateLimiter
from specimap_service.errors import RateLimitedError
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving


def test_health_needs_no_key_and_everything_else_does(service: Running) -> None:
    with httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS) as stranger:
        assert stranger.get("/healthz").json()["status"] == "ok"
        assert stranger.get("/readyz").json() == {"status": "ready", "workers": 0}
        for path in ("/v1/keys", "/metrics", "/v1/audit"):
            answer = stranger.get(path)
            assert answer.status_code == 401
            assert answer.headers["content-type"] == "application/problem+json"
            assert answer.headers["www-authenticate"] == "Bearer"
            assert answer.json()["code"] == "unauthorized"


def test_key_is_shown_once_hashed_at_rest_and_revoked(service: Running) -> None:
    admin = service.client()
    made = admin.post("/v1/keys", json={"name": "tablet", "scopes": ["read"]}).json()
    secret = made["key"].rsplit("_", 1)[1]
    assert len(secret) == 64
    stored = sqlite3.connect(service.settings.data_dir / "specimap.db")
    assert all(secret not in line for line in stored.iterdump())
    stored.close()
    assert "key" not in next(k for k in admin.get("/v1/keys").json() if k["id"] == made["id"])
    with httpx.Client(base_url=service.url, trust_env=False, verify=NO_TLS) as holder:
        holder.headers["Authorization"] = f"Bearer {made['key']}"
        refused = holder.get("/v1/keys")
        assert (refused.status_code, refused.json()["details"]) == (403, {"scope": "admin"})
        assert admin.delete(f"/v1/keys/{made['id']}").status_code == 204
        assert holder.get("/v1/keys").json()["code"] == "unauthorized"
    audited = admin.get("/v1/audit", params={"target": made["id"]}).json()["items"]
    assert [entry["action"] for entry in audited] == ["key.revoke", "key.create"]


@pytest.mark.parametrize("wrong", ["x", "spk_", "spk_x_y", "nonsense", "spk_" + "0" * 26 + "_" + "0" * 64])
def test_wrong_keys_are_refused_alike(service: Running, wrong: str) -> None:
    answer = httpx.get(
        f"{service.url}/v1/keys", headers={"Authorization": f"Bearer {wrong}"}, trust_env=False, verify=NO_TLS
    )
    assert (answer.status_code, answer.json()["code"]) == (401, "unauthorized")


def test_expired_key_is_refused(service: Running) -> None:
    admin = service.client()
    made = admin.post("/v1/keys", json={"name": "old", "scopes": ["admin"], "expires_at": "2100-01-01T00:00:00Z"})
    with service.database.session() as session:
        session.execute(sa.update(ApiKey).where(ApiKey.id == made.json()["id"]).values(expires_at=utc_now()))
    answer = httpx.get(
        f"{service.url}/v1/keys",
        headers={"Authorization": f"Bearer {made.json()['key']}"},
        trust_env=False,
        verify=NO_TLS,
    )
    assert answer.status_code == 401


@pytest.mark.parametrize("past", ["2020-01-01T00:00:00Z", "now"])
def test_no_key_is_made_that_has_expired(service: Running, past: str) -> None:
    admin = service.client()
    asked = {"name": "old", "scopes": ["read"], "expires_at": utc_now().isoformat() if past == "now" else past}
    answer = admin.post("/v1/keys", json=asked)
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert answer.json()["details"]["fields"][0]["where"] == "body.expires_at"
    assert [key["name"] for key in admin.get("/v1/keys").json()] == ["test"]


def test_too_many_requests_are_told_when_to_come_back(service: Running) -> None:
    hasty = service.client(rate_per_minute=5)
    codes = [hasty.get("/v1/keys").status_code for _ in range(8)]
    assert codes[:5] == [200] * 5
    assert set(codes[5:]) == {429}
    assert 1 <= int(hasty.get("/v1/keys").headers["retry-after"]) <= 12


def test_bucket_refills_evenly() -> None:
    now = 0.0
    limiter = RateLimiter(lambda: now)
    for _ in range(60):
        limiter.take("a", 60)
    with pytest.raises(RateLimitedError):
        limiter.take("a", 60)
    limiter.take("b", 60)
    now = 1.01
    limiter.take("a", 60)
    with pytest.raises(RateLimitedError):
        limiter.take("a", 60)


def test_correlation_id_is_taken_over_or_made(service: Running) -> None:
    client = service.client()
    mine = client.get("/v1/nowhere", headers={"X-Correlation-Id": "ward-7.2026-11"})
    assert mine.headers["x-correlation-id"] == mine.json()["correlation_id"] == "ward-7.2026-11"
    bad = client.get("/v1/nowhere", headers={"X-Correlation-Id": "a b\tc"})
    assert bad.json()["correlation_id"] == bad.headers["x-correlation-id"] != "a b\tc"
    assert bad.status_code == 404


def test_invalid_body_names_the_field(service: Running) -> None:
    answer = service.client().post("/v1/keys", json={"name": "x", "scopes": ["root"], "more": 1})
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert {field["where"] for field in answer.json()["details"]["fields"]} >= {"body.scopes.0", "body.more"}


@pytest.mark.parametrize("name", ["", "a\0b", "a\nb", "a\x1b[31m", "a\u202eb", "a" * 101])
def test_name_that_does_not_show_as_it_is_is_refused(service: Running, name: str) -> None:
    answer = service.client().post("/v1/keys", json={"name": name, "scopes": ["read"]})
    assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")
    assert [field["where"] for field in answer.json()["details"]["fields"]] == ["body.name"]


def test_metrics_count_requests_and_jobs(service: Running) -> None:
    admin = service.client()
    for _ in range(3):
        admin.get("/v1/keys")
    text = admin.get("/metrics").text
    line = 'specimap_requests_handle_seconds_count{method="GET",route="/v1/keys",status="200"}'
    assert f"{line} 3.0" in text
    assert 'specimap_jobs{state="queued"} 0.0' in text
    assert "specimap_storage_free_bytes" in text


def test_pages_of_other_origins_may_call_only_where_allowed(tmp_path: Path) -> None:
    with serving(tmp_path, cors_origins=["https://viewer.example"]) as running:
        client = running.client()
        allowed = client.get("/healthz", headers={"Origin": "https://viewer.example"})
        assert allowed.headers["access-control-allow-origin"] == "https://viewer.example"
        assert "content-range" in allowed.headers["access-control-expose-headers"].lower()
        other = client.get("/healthz", headers={"Origin": "https://elsewhere.example"})
        assert "access-control-allow-origin" not in other.headers


def test_endless_json_is_refused(service: Running) -> None:
    client = service.client()
    declared = client.post("/v1/keys", content=b" " * (17 << 20), headers={"Content-Type": "application/json"})
    assert (declared.status_code, declared.json()["code"]) == (413, "payload_too_large")
    pieces = (b" " * (1 << 20) for _ in range(17))
    streamed = client.post("/v1/keys", content=pieces, headers={"Content-Type": "application/json"})
    assert (streamed.status_code, streamed.json()["code"]) == (413, "payload_too_large")
