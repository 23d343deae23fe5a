"""Requests that make something, sent again under the same Idempotency-Key."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.database import utc_now
from specimap_infra.tables import Acquisition, ApiKey, Delivery, Export, Job, Project, RepeatableRequest, Share, Upload
from specimap_service.contract.description import operations
from specimap_service.idempotency import KEPT
from tests.support.documented import contract
from tests.support.job_scene import acquisition, queued_job
from tests.support.plain_http import NO_TLS
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import TUS, metadata, new_acquisition

HEADER = {"Idempotency-Key": "case 17"}


@pytest.fixture
def any_service(any_database: str, tmp_path: Path) -> Iterator[Running]:
    with serving(tmp_path / "service", database_url=any_database, webhook_hosts=["127.0.0.1"]) as running:
        yield running


Send = Callable[[httpx.Client, dict[str, str]], httpx.Response]


def requests_of(service: Running, folder: Path) -> dict[str, tuple[Send, Send, Any]]:
    """For each operation: the request, another one, and the table of what it makes."""
    owner, cloud = acquisition(service.database), put_result(service, folder).cloud_id
    target = new_acquisition(service.client())

    def posts(path: str, body: dict[str, Any]) -> Send:
        return lambda client, headers: client.post(path, json=body, headers=headers)

    def uploads(length: int) -> Send:
        given = {
            **TUS,
            "Upload-Length": str(length),
            "Upload-Metadata": metadata(acquisition=target, role="photo", filename="a.jpg"),
        }
        return lambda client, headers: client.post("/v1/uploads", headers={**given, **headers})

    def reruns(body: dict[str, Any]) -> Send:
        job = service.client().post("/v1/jobs", json={"acquisition_id": owner}).json()["id"]
        return posts(f"/v1/jobs/{job}/rerun", body)

    sent = queued_job(service.database, owner, webhook={"url": "http://127.0.0.1:9/", "secret": "0" * 16})
    other = queued_job(service.database, owner, webhook={"url": "http://127.0.0.1:9/", "secret": "0" * 16})
    with service.database.session() as session:
        for job in (sent, other):
            jobs.request_cancel(session, job)
    key, soon = {"name": "tablet", "scopes": ["read"]}, (utc_now() + datetime.timedelta(days=1)).isoformat()
    rerun = reruns({"priority": "research"})
    return {
        "acquisitions.create": (
            posts("/v1/acquisitions", {"specimen_id": "S-7"}),
            posts("/v1/acquisitions", {"specimen_id": "S-8"}),
            Acquisition,
        ),
        "projects.create": (posts("/v1/projects", {"name": "a"}), posts("/v1/projects", {"name": "b"}), Project),
        "keys.create": (posts("/v1/keys", key), posts("/v1/keys", {**key, "scopes": ["label"]}), ApiKey),
        "exports.create": (
            posts(f"/v1/clouds/{cloud}/exports/ply", {}),
            posts(f"/v1/clouds/{cloud}/exports/npz", {}),
            Export,
        ),
        "shares.create": (
            posts(f"/v1/clouds/{cloud}/shares", {"name": "a", "expires_at": soon}),
            posts(f"/v1/clouds/{cloud}/shares", {"name": "b", "expires_at": soon}),
            Share,
        ),
        "uploads.create": (uploads(300), uploads(301), Upload),
        "jobs.create": (
            posts("/v1/jobs", {"acquisition_id": owner}),
            posts("/v1/jobs", {"acquisition_id": owner, "priority": "research"}),
            Job,
        ),
        "deliveries.create": (
            posts(f"/v1/jobs/{sent}/deliveries", {}),
            posts(f"/v1/jobs/{other}/deliveries", {}),
            Delivery,
        ),
        "jobs.rerun": (rerun, posts("/v1/jobs", {"acquisition_id": owner}), Job),
    }


def count(service: Running, table: Any) -> int:
    """The rows of a table."""
    with service.database.session() as session:
        return session.scalar(sa.select(sa.func.count()).select_from(table)) or 0


def made(answer: httpx.Response) -> Any:
    """What a request made."""
    return answer.headers["location"] if answer.request.url.path == "/v1/uploads" else answer.json()


def test_every_operation_that_creates_takes_an_idempotency_key(service: Running, tmp_path: Path) -> None:
    takes = {
        operation["operationId"]
        for method, _, operation in operations(contract())
        if any(parameter["name"] == "idempotency-key" for parameter in operation.get("parameters", ()))
    }
    assert takes == set(requests_of(service, tmp_path / "result"))


def test_a_request_sent_again_makes_nothing_more(any_service: Running, tmp_path: Path) -> None:
    for name, (send, different, table) in requests_of(any_service, tmp_path / "result").items():
        client = any_service.client()
        before = count(any_service, table)
        first = send(client, HEADER)
        assert first.status_code in (201, 202), f"{name}: {first.text}"
        again = send(client, HEADER)
        assert again.is_success, f"{name}: {again.text}"
        assert made(again) == made(first), name
        assert count(any_service, table) == before + 1, name
        refused = different(client, HEADER)
        assert (refused.status_code, refused.json()["code"]) == (409, "idempotency_conflict"), name
        if name not in ("exports.create", "projects.create"):  # which are the same for all
            other = send(any_service.client(), HEADER)
            assert other.is_success, f"{name}: {other.text}"
            assert made(other) != made(first), name


def test_a_request_sent_many_times_at_once_makes_one_object(any_service: Running, tmp_path: Path) -> None:
    for name, (send, _, table) in requests_of(any_service, tmp_path / "result").items():
        if name == "jobs.rerun":
            continue  # the same as jobs.create
        client = any_service.client()
        before = count(any_service, table)
        with ThreadPoolExecutor(6) as pool:
            answers = list(pool.map(lambda _, send=send, client=client: send(client, HEADER), range(6)))
        assert all(answer.is_success for answer in answers), f"{name}: {[answer.text for answer in answers]}"
        assert count(any_service, table) == before + 1, name
        assert len({str(made(answer)) for answer in answers}) == 1, name


def test_a_key_made_again_is_the_same_and_works(service: Running) -> None:
    client = service.client()
    body = {"name": "tablet", "scopes": ["read"]}
    first, again = (client.post("/v1/keys", json=body, headers=HEADER).json()["key"] for _ in range(2))
    assert first == again
    for key in (first, client.post("/v1/keys", json=body).json()["key"]):
        answer = httpx.get(
            f"{service.url}/v1/jobs", headers={"Authorization": f"Bearer {key}"}, trust_env=False, verify=NO_TLS
        )
        assert answer.status_code == 200
    secret = first.rpartition("_")[2]
    with service.database.session() as session:
        for row in session.scalars(sa.select(RepeatableRequest)):
            assert secret not in f"{row.salt} {row.request_hash} {row.object_id}"


def test_what_was_made_and_deleted_is_not_made_again(service: Running) -> None:
    client = service.client()
    made = client.post("/v1/acquisitions", json={"specimen_id": "S-7"}, headers=HEADER).json()["id"]
    assert client.delete(f"/v1/acquisitions/{made}").status_code == 204
    answer = client.post("/v1/acquisitions", json={"specimen_id": "S-7"}, headers=HEADER)
    assert (answer.status_code, answer.json()["code"]) == (404, "not_found")


def test_a_refused_request_leaves_its_key_free(service: Running) -> None:
    client = service.client()
    refused = client.post("/v1/keys", json={"name": "x", "scopes": ["read"], "project": "none"}, headers=HEADER)
    assert refused.status_code == 404
    assert client.post("/v1/keys", json={"name": "x", "scopes": ["read"]}, headers=HEADER).status_code == 201


def test_requests_are_kept_for_the_stated_time(service: Running) -> None:
    client = service.client()

    def ask() -> str:
        answer = client.post("/v1/acquisitions", json={"specimen_id": "S-7"}, headers=HEADER)
        return str(answer.json()["id"])

    def grow_older(by: datetime.timedelta) -> None:
        with service.database.session() as session:
            session.execute(sa.update(RepeatableRequest).values(created_at=utc_now() - by))

    first = ask()
    grow_older(KEPT - datetime.timedelta(minutes=1))
    assert ask() == first
    grow_older(KEPT + datetime.timedelta(minutes=1))
    second = ask()
    assert second != first
    assert ask() == second
