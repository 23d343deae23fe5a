"""Deliveries of a job's webhook: listed, and made again on request."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from specimap_infra import jobs
from specimap_infra.webhooks import deliver_due, webhook_client
from tests.support.job_scene import acquisition, queued_job
from tests.support.service_scene import Running, serving
from tests.support.webhook_receiver import Receiver

SECRET = "0123456789abcdef"


@pytest.fixture
def sending(tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", webhook_hosts=["127.0.0.1"], webhook_attempts=1) as running:
        yield running


def test_a_delivery_is_listed_and_made_again(sending: Running, receiver: Receiver) -> None:
    database, client = sending.database, sending.client(["read", "upload"])
    job = queued_job(database, acquisition(database), webhook={"url": receiver.url, "secret": SECRET})
    at = f"/v1/jobs/{job}/deliveries"
    assert client.get(at).json() == []
    early = client.post(at)
    assert (early.status_code, early.json()["code"]) == (409, "state_conflict")
    with database.session() as session:
        jobs.claim(session, job, "executor")
        jobs.finish(session, job, "executor", "succeeded")
    receiver.answers = [500, 204]
    with webhook_client() as http:
        assert deliver_due(database, sending.settings, http) == 1
        (lost,) = client.get(at).json()
        assert (lost["state"], lost["attempts"], lost["last_status"]) == ("given_up", 1, "500")
        again = client.post(at, headers={"Idempotency-Key": "once"})
        assert again.status_code == 202
        assert again.json()["state"] == "pending"
        same = client.post(at, headers={"Idempotency-Key": "once"})
        assert (same.status_code, same.json()["id"]) == (200, again.json()["id"])
        assert deliver_due(database, sending.settings, http) == 1
    first, second = client.get(at).json()
    assert first == lost
    assert (second["id"], second["state"], second["last_status"]) == (again.json()["id"], "delivered", "204")
    bodies = [json.loads(body)["job"]["id"] for _, body in receiver.got]
    assert bodies == [job, job]
    assert [headers["x-specimap-delivery"] for headers, _ in receiver.got] == [first["id"], second["id"]]
    assert SECRET not in client.get(at).text


def test_only_a_job_with_a_webhook_is_delivered(sending: Running) -> None:
    client = sending.client(["read", "upload"])
    job = queued_job(sending.database, acquisition(sending.database))
    refused = client.post(f"/v1/jobs/{job}/deliveries")
    assert (refused.status_code, refused.json()["code"]) == (409, "state_conflict")


def test_a_host_that_is_no_longer_allowed_gets_nothing(service: Running) -> None:
    job = queued_job(
        service.database, acquisition(service.database), webhook={"url": "http://127.0.0.1:9/x", "secret": SECRET}
    )
    with service.database.session() as session:
        jobs.request_cancel(session, job)
    client = service.client(["read", "upload"])
    refused = client.post(f"/v1/jobs/{job}/deliveries")
    assert (refused.status_code, refused.json()["code"]) == (422, "setting_invalid")
    assert len(client.get(f"/v1/jobs/{job}/deliveries").json()) == 1
