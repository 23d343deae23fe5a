"""Webhooks against a real server: signed, repeated, given up, sent once by two; only to hosts that are named."""

from __future__ import annotations

import datetime
import hashlib
import hmac
import json
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_core.errors import SettingsError
from specimap_infra import jobs, webhooks
from specimap_infra.database import Database, utc_now
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.tables import Delivery
from specimap_infra.webhooks import check_target, deliver_due, webhook_client
from tests.support.job_scene import EXECUTOR, acquisition, queued_job
from tests.support.service_scene import serving
from tests.support.webhook_receiver import Receiver

SECRET = "0123456789abcdef-ü"


@pytest.fixture
def client() -> Iterator[httpx.Client]:
    with webhook_client() as found:
        yield found


def settings(tmp_path: Path, attempts: int = 8) -> ServiceSettings:
    return load_settings(data_dir=tmp_path, webhook_hosts=["127.0.0.1"], webhook_attempts=attempts)


def ended_job(database: Database, url: str, error: dict[str, Any] | None = None) -> str:
    """A job that has ended and whose webhook is due; the delivery's id."""
    job_id = queued_job(database, webhook={"url": url, "secret": SECRET})
    with database.session() as session:
        jobs.claim(session, job_id, EXECUTOR)
        jobs.finish(session, job_id, EXECUTOR, "failed" if error else "succeeded", error, {"adjust": 1.5})
        return session.scalars(sa.select(Delivery.id).where(Delivery.job_id == job_id)).one()


def delivery(database: Database, delivery_id: str) -> Delivery:
    with database.session() as session:
        return session.get_one(Delivery, delivery_id)


def make_due(database: Database) -> None:
    """As if the time to the next attempt had passed."""
    with database.session() as session:
        session.execute(sa.update(Delivery).values(next_at=utc_now() - datetime.timedelta(seconds=1)))


def test_delivery_is_signed_and_carries_the_job(
    tables: Database, tmp_path: Path, receiver: Receiver, client: httpx.Client
) -> None:
    before = utc_now()
    delivery_id = ended_job(tables, receiver.url)
    assert deliver_due(tables, settings(tmp_path), client) == 1
    assert deliver_due(tables, settings(tmp_path), client) == 0
    ((headers, body),) = receiver.got
    stamp, _, signature = headers["x-specimap-signature"].partition(",")
    at = stamp.removeprefix("t=")
    expected = hmac.new(SECRET.encode(), at.encode() + b"." + body, hashlib.sha256).hexdigest()
    assert signature == f"v1={expected}"
    assert int(before.timestamp()) <= int(at) <= utc_now().timestamp()
    assert headers["x-specimap-delivery"] == delivery_id
    assert headers["content-type"] == "application/json"
    described = json.loads(body)
    assert (described["event"], described["job"]["state"], described["job"]["seconds"]) == (
        "job.succeeded",
        "succeeded",
        {"adjust": 1.5},
    )
    assert before <= datetime.datetime.fromisoformat(described["delivered_at"]) <= utc_now()
    assert SECRET not in body.decode()
    assert "webhook" not in described["job"]
    row = delivery(tables, delivery_id)
    assert (row.state, row.attempts, row.last_status) == ("delivered", 1, "200")


def test_known_signature() -> None:
    # printf '1700000000.{}' | openssl dgst -sha256 -hmac key
    digest = "9d713ed406bb7076d4123f0dc2c39d2df5c654ed4b0cd56b52c8b4c940bd63ae"
    assert webhooks.sign("key", b"{}", 1700000000) == f"t=1700000000,v1={digest}"


@pytest.mark.slow
@pytest.mark.parametrize("first", [500, 404, 302])
def test_refused_delivery_is_repeated_later(
    tables: Database, tmp_path: Path, receiver: Receiver, client: httpx.Client, first: int
) -> None:
    receiver.answers = [first, first, 204]
    delivery_id = ended_job(tables, receiver.url, {"code": "x", "message": "", "advice": "", "details": {}})
    for attempt in (1, 2):
        before = utc_now()
        assert deliver_due(tables, settings(tmp_path), client) == 1
        row = delivery(tables, delivery_id)
        assert (row.state, row.attempts, row.last_status) == ("pending", attempt, str(first))
        wait = (row.next_at - before).total_seconds()
        assert 2**attempt <= wait < 2**attempt + 20
        assert deliver_due(tables, settings(tmp_path), client) == 0
        make_due(tables)
    assert deliver_due(tables, settings(tmp_path), client) == 1
    assert delivery(tables, delivery_id).state == "delivered"
    assert len(receiver.got) == 3
    assert {headers["x-specimap-delivery"] for headers, _ in receiver.got} == {delivery_id}
    assert json.loads(receiver.got[0][1])["event"] == "job.failed"


def test_delivery_is_given_up_at_last(tables: Database, tmp_path: Path, client: httpx.Client) -> None:
    # A port that was free a moment ago: nobody listens.
    with ThreadingHTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler) as server:
        url = f"http://127.0.0.1:{server.server_address[1]}/"
    delivery_id = ended_job(tables, url)
    for _ in range(3):
        assert deliver_due(tables, settings(tmp_path, attempts=3), client) == 1
        make_due(tables)
    row = delivery(tables, delivery_id)
    assert (row.state, row.attempts, row.last_status) == ("given_up", 3, "ConnectError")
    assert deliver_due(tables, settings(tmp_path, attempts=3), client) == 0


@pytest.mark.slow
def test_two_deliverers_at_once_send_once(tables: Database, tmp_path: Path, receiver: Receiver) -> None:
    ids = {ended_job(tables, receiver.url) for _ in range(12)}
    start = threading.Barrier(4)

    def deliver(_: int) -> int:
        with webhook_client() as client:
            start.wait()
            return deliver_due(tables, settings(tmp_path), client)

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(deliver, range(4))) == 12
    assert sorted(headers["x-specimap-delivery"] for headers, _ in receiver.got) == sorted(ids)
    assert {delivery(tables, delivery_id).attempts for delivery_id in ids} == {1}


def test_delivery_whose_sender_died_is_due_again(
    sqlite_tables: Database, tmp_path: Path, receiver: Receiver, monkeypatch: pytest.MonkeyPatch, client: httpx.Client
) -> None:
    delivery_id = ended_job(sqlite_tables, receiver.url)

    def dies(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(webhooks, "_record_attempt", dies)
        with pytest.raises(KeyboardInterrupt):
            deliver_due(sqlite_tables, settings(tmp_path), client)
    assert deliver_due(sqlite_tables, settings(tmp_path), client) == 0
    wait = (delivery(sqlite_tables, delivery_id).next_at - utc_now()).total_seconds()
    assert 60 < wait <= 90
    make_due(sqlite_tables)
    assert deliver_due(sqlite_tables, settings(tmp_path), client) == 1
    assert delivery(sqlite_tables, delivery_id).state == "delivered"


def test_host_that_is_no_longer_allowed_gets_nothing(
    sqlite_tables: Database, tmp_path: Path, receiver: Receiver, client: httpx.Client
) -> None:
    delivery_id = ended_job(sqlite_tables, receiver.url)
    assert deliver_due(sqlite_tables, load_settings(data_dir=tmp_path), client) == 1
    assert receiver.got == []
    assert delivery(sqlite_tables, delivery_id).last_status == "host not allowed"


@pytest.mark.parametrize(
    ("url", "fits"),
    [
        ("https://pacs.example/hook", True),
        ("https://PACS.example:9000/hook", True),
        ("http://ris.example:8080/", True),
        ("http://ris.example/", False),
        ("https://other.example/", False),
        ("https://pacs.example.evil.example/", False),
        ("https://pacs.example@evil.example/", False),
        ("https://user:word@pacs.example/", False),
        ("ftp://pacs.example/", False),
        ("file:///etc/passwd", False),
        ("https:///hook", False),
        ("https://pacs.example\\@evil.example/", False),
        ("nonsense", False),
        ("https://[::1", False),
    ],
)
def test_addresses_that_are_allowed(tmp_path: Path, url: str, fits: bool) -> None:
    allowed = load_settings(data_dir=tmp_path, webhook_hosts=["Pacs.example", "ris.example:8080"])
    if fits:
        check_target(url, allowed)
    else:
        with pytest.raises(SettingsError) as caught:
            check_target(url, allowed)
        assert caught.value.details == {"setting": "webhook.url"}


@pytest.mark.slow
def test_host_is_checked_when_the_job_is_made(tmp_path: Path, receiver: Receiver, client: httpx.Client) -> None:
    with serving(tmp_path, webhook_hosts=["127.0.0.1"]) as service:
        api = service.client()
        owner = acquisition(service.database)
        webhook = {"url": "https://elsewhere.example/", "secret": SECRET}
        refused = api.post("/v1/jobs", json={"acquisition_id": owner, "webhook": webhook})
        assert (refused.status_code, refused.json()["code"]) == (422, "setting_invalid")
        assert api.get("/v1/jobs").json()["items"] == []
        webhook["url"] = receiver.url
        job = api.post("/v1/jobs", json={"acquisition_id": owner, "webhook": webhook})
        assert job.status_code == 202
        assert SECRET not in job.text
        again = api.post(f"/v1/jobs/{job.json()['id']}/rerun").json()["id"]
        silent = api.post(f"/v1/jobs/{job.json()['id']}/rerun", json={"webhook": None}).json()["id"]
        for job_id in (job.json()["id"], again, silent):
            api.post(f"/v1/jobs/{job_id}/cancel")
        assert deliver_due(service.database, service.settings, client) == 2
    described = [json.loads(body) for _, body in receiver.got]
    assert {(t["event"], t["job"]["id"]) for t in described} == {
        ("job.cancelled", job.json()["id"]),
        ("job.cancelled", again),
    }
