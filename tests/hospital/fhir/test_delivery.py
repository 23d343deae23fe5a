"""Telling a server of results: once, over failures and restarts; and what is kept of its answers."""

from __future__ import annotations

import datetime
import json
import socket
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa

from specimap_hospital.fhir.bundle import transaction
from specimap_hospital.fhir.client import FhirClient
from specimap_hospital.fhir.delivery import FhirSender
from specimap_hospital.fhir.elements import Element, Systems
from specimap_hospital.fhir.errors import FhirRefusedError, FhirUnavailableError, PatientMissingError
from specimap_hospital.fhir.notices import tell_of
from specimap_infra.database import Database, utc_now
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.tables import CloudRow, FhirNotice, Job
from tests.hospital.fhir.scene import CONTEXT, result
from tests.hospital.fhir.server import FhirServer, fhir_server
from tests.support.job_scene import queued_job

PLANTED = ("Doe", "PID-7", "ACC-1")


@pytest.fixture
def server() -> Iterator[FhirServer]:
    with fhir_server() as found:
        yield found


def settings(tmp_path: Path, server: FhirServer, **given: Any) -> ServiceSettings:
    return load_settings(data_dir=tmp_path, fhir_url=server.url, **given)


def cloud(database: Database) -> str:
    """A result that the server is to be told of."""
    job_id = queued_job(database)
    cloud_id = job_id.replace("job_", "cloud_")
    with database.session() as session:
        job = session.get_one(Job, job_id)
        session.add(
            CloudRow(
                id=cloud_id,
                job_id=job_id,
                acquisition_id=job.acquisition_id,
                prefix=f"clouds/{cloud_id}",
                points=1,
                bands=1,
                size=1,
                report={},
            )
        )
        session.flush()
        tell_of(session, cloud_id, 1, utc_now())
    return cloud_id


def notice(database: Database, cloud_id: str) -> FhirNotice:
    with database.session() as session:
        return session.get_one(FhirNotice, cloud_id)


def make_due(database: Database) -> None:
    with database.session() as session:
        session.execute(sa.update(FhirNotice).values(next_at=utc_now() - datetime.timedelta(seconds=1)))


def bundle_of(cloud_id: str) -> Element:
    return transaction(CONTEXT, result(), Systems())


def sender(database: Database, client: FhirClient, attempts: int = 50) -> FhirSender:
    return FhirSender(database, client, bundle_of, attempts=attempts)


def test_a_server_has_everything_once_however_often_it_is_told(
    tables: Database, tmp_path: Path, server: FhirServer
) -> None:
    cloud_id = cloud(tables)
    found = sender(tables, FhirClient(settings(tmp_path, server, fhir_token="t0p")))
    assert [found.step(), found.step()] == [1, 0]
    assert notice(tables, cloud_id).state == "sent"
    assert server.requests[0]["Authorization"] == "Bearer t0p"
    with tables.session() as session:
        tell_of(session, cloud_id, 1, utc_now())
    assert found.step() == 1
    counts = {kind: len(rows) for kind, rows in server.store.items()}
    assert counts == {"Specimen": 1, "ImagingStudy": 1, "Device": 1, "Observation": 4, "DiagnosticReport": 1}


def test_two_processes_tell_of_each_result_once(tables: Database, tmp_path: Path, server: FhirServer) -> None:
    told = {cloud(tables) for _ in range(10)}
    client = FhirClient(settings(tmp_path, server))
    with ThreadPoolExecutor(4) as pool:
        attempted = list(pool.map(lambda _: sender(tables, client).step(), range(4)))
    assert sum(attempted) == len(told) == len(server.requests)
    assert {notice(tables, cloud_id).state for cloud_id in told} == {"sent"}


@pytest.mark.parametrize("status", [401, 403, 404, 409, 429, 500, 503])
def test_what_passes_is_tried_again_later(tables: Database, tmp_path: Path, server: FhirServer, status: int) -> None:
    cloud_id = cloud(tables)
    server.answers = [(status, {"resourceType": "OperationOutcome", "issue": [{"code": "transient"}]})]
    found = sender(tables, FhirClient(settings(tmp_path, server)))
    assert found.step() == 1
    row = notice(tables, cloud_id)
    assert (row.state, row.attempts) == ("pending", 1)
    assert row.error is not None
    assert row.error["code"] == "fhir_unavailable"
    assert row.error["details"] == {"status": status, "issues": ["transient"]}
    assert row.next_at > utc_now()
    assert found.step() == 0
    make_due(tables)
    assert found.step() == 1
    assert (notice(tables, cloud_id).state, notice(tables, cloud_id).error) == ("sent", None)


def test_a_refusal_is_kept_by_its_code_without_the_words(
    tables: Database, tmp_path: Path, server: FhirServer, caplog: pytest.LogCaptureFixture
) -> None:
    cloud_id = cloud(tables)
    words = {"code": "invalid", "diagnostics": "Doe^Jane PID-7 is unknown"}
    hostile = {"code": "Doe^Jane, a patient of the hospital"}
    server.answers = [(422, {"resourceType": "OperationOutcome", "issue": [words, hostile, "none", {}]})]
    sender(tables, FhirClient(settings(tmp_path, server))).step()
    row = notice(tables, cloud_id)
    assert row.state == "refused"
    assert row.error is not None
    assert row.error["details"] == {"status": 422, "issues": ["invalid"]}
    assert not any(word in json.dumps(row.error) + caplog.text for word in PLANTED)


def test_a_server_that_takes_a_part_alone_is_said(tables: Database, tmp_path: Path, server: FhirServer) -> None:
    entries = [{"response": {"status": status}} for status in ("201 Created", "422 Unprocessable")]
    server.answers = [(200, {"resourceType": "Bundle", "entry": entries})]
    with pytest.raises(FhirRefusedError) as caught:
        FhirClient(settings(tmp_path, server)).post(bundle_of(""))
    assert caught.value.details["entries"] == ["422"]


def test_it_gives_up_after_the_attempts_and_goes_on_when_asked(
    tables: Database, tmp_path: Path, server: FhirServer
) -> None:
    cloud_id = cloud(tables)
    server.answers = [(503, {}), (503, {})]
    found = sender(tables, FhirClient(settings(tmp_path, server)), attempts=2)
    for _ in range(2):
        make_due(tables)
        found.step()
    assert notice(tables, cloud_id).state == "given_up"
    with tables.session() as session:
        tell_of(session, cloud_id, 1, utc_now())
    found.step()
    assert notice(tables, cloud_id).state == "sent"


def test_a_result_that_cannot_be_told_says_why(tables: Database, tmp_path: Path, server: FhirServer) -> None:
    def refuse(cloud_id: str) -> Element:
        raise PatientMissingError("The study context names no patient.", advice="Enter the patient's id.")

    cloud_id = cloud(tables)
    FhirSender(tables, FhirClient(settings(tmp_path, server)), refuse, attempts=3).step()
    row = notice(tables, cloud_id)
    assert row.state == "refused"
    assert row.error is not None
    assert row.error["code"] == "patient_missing"
    assert server.requests == []


def test_a_process_that_died_leaves_its_result_to_the_next(
    tables: Database, tmp_path: Path, server: FhirServer
) -> None:
    cloud_id = cloud(tables)

    def die(cloud_id: str) -> Element:
        raise KeyboardInterrupt

    client = FhirClient(settings(tmp_path, server))
    with pytest.raises(KeyboardInterrupt):
        FhirSender(tables, client, die, attempts=3).step()
    assert sender(tables, client).step() == 0
    make_due(tables)
    assert sender(tables, client).step() == 1
    assert notice(tables, cloud_id).state == "sent"


def test_tokens_come_from_their_server_and_are_kept_until_they_end(tmp_path: Path, server: FhirServer) -> None:
    client = FhirClient(
        settings(
            tmp_path, server, fhir_token_url=f"{server.url}/token", fhir_client_id="specimap", fhir_client_secret="s"
        )
    )
    client.post(bundle_of(""))
    client.post(bundle_of(""))
    assert server.tokens == ["grant_type=client_credentials&scope=system/*.write"]
    sent = [request for request in server.requests if request["path"] == "/"]
    assert {request["Authorization"] for request in sent} == {"Bearer token-1"}
    # A token that the server does not take is not used again.
    server.answers = [(401, {})]
    with pytest.raises(FhirUnavailableError):
        client.post(bundle_of(""))
    client.post(bundle_of(""))
    assert len(server.tokens) == 2


def test_a_server_that_is_away_or_hangs_up_is_unavailable(tmp_path: Path, server: FhirServer) -> None:
    server.answers = [lambda: None]
    with pytest.raises(FhirUnavailableError):
        FhirClient(settings(tmp_path, server)).post(bundle_of(""))
    with socket.create_server(("127.0.0.1", 0)) as free:
        url = f"http://127.0.0.1:{free.getsockname()[1]}"
    with pytest.raises(FhirUnavailableError):
        FhirClient(load_settings(data_dir=tmp_path, fhir_url=url)).post(bundle_of(""))
