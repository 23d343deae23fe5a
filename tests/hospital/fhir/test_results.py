"""A result of the service, told to a FHIR server by the process of the hospital's side."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from specimap_hospital.fhir.notices import add_notices
from specimap_hospital.process import HospitalProcess
from specimap_infra.database import utc_now
from specimap_infra.tables import CloudRow, DicomSet, FhirNotice
from tests.hospital.fhir.server import FhirServer, fhir_server
from tests.hospital.fhir.validation import validated
from tests.support.hospital_scene import KEY, PATIENT, PLANTED, as_json
from tests.support.outbox_scene import waiting_cloud
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving


@pytest.fixture
def server() -> Iterator[FhirServer]:
    with fhir_server() as found:
        yield found


@contextmanager
def hospital(running: Running) -> Iterator[None]:
    """The process of the hospital's side, in a thread."""
    process = HospitalProcess(running.settings)
    thread = threading.Thread(target=process.run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        process.stop()
        thread.join(timeout=30)
        assert not thread.is_alive()


def wait_for(found: Callable[[], Any]) -> Any:
    end = time.monotonic() + 120
    while not (value := found()):
        assert time.monotonic() < end
        time.sleep(0.1)
    return value


def test_a_result_with_a_study_context_is_told(server: FhirServer, tmp_path: Path) -> None:
    given: dict[str, Any] = {"study_keys": [KEY], "fhir_url": server.url, "public_url": "https://specimap.example"}
    with serving(tmp_path / "service", **given) as running:
        client = running.client()
        result = put_result(running, tmp_path / "result")
        address = f"/v1/clouds/{result.cloud_id}/fhir"
        assert client.get(address).status_code == 404
        asked = client.post(address)
        assert (asked.status_code, asked.json()["code"]) == (409, "study_missing")
        client.put(f"/v1/acquisitions/{result.acquisition_id}/study", json=as_json()).raise_for_status()
        with hospital(running):
            told = wait_for(lambda: client.get(address).json().get("sent_at") and client.get(address).json())
            assert (told["state"], told["error"]) == ("sent", None)
            # Another context is told, too; the same one is not.
            changed = as_json(PATIENT.model_copy(update={"specimen_identifier": "SPEC-78"}))
            client.put(f"/v1/acquisitions/{result.acquisition_id}/study", json=changed).raise_for_status()
            wait_for(lambda: len(server.bundles) == 2 and client.get(address).json()["state"] == "sent")
            assert client.post(address).status_code == 202
            wait_for(lambda: len(server.bundles) == 3)
        with running.database.session() as session:
            figures = session.get_one(CloudRow, result.cloud_id).report
        events = client.get(f"/v1/jobs/{result.job_id}").text + client.get(address).text
        assert not any(word in events for word in PLANTED)
    (report,) = server.store["DiagnosticReport"]
    # No archive has its objects, so there is no study to look at.
    assert set(server.store) == {"Specimen", "Device", "Observation", "DiagnosticReport"}
    assert report["subject"]["identifier"]["value"] == PATIENT.patient_id
    assert report["basedOn"][0]["identifier"]["value"] == PATIENT.accession_number
    assert report["presentedForm"][0]["url"] == f"https://specimap.example/#/view/{result.cloud_id}"
    quantities = [item["valueQuantity"] for item in server.store["Observation"] if "valueQuantity" in item]
    per_mm = {"mm": 1, "um": 1000}
    values_mm = [item["value"] / per_mm[item["code"]] for item in quantities if item["code"] in per_mm]
    for figure in (figures["corner_2d_mm"]["mean"], figures["corner_3d_mm"]["median"]):
        assert any(value == pytest.approx(figure, rel=1e-4) for value in values_mm), figure
    assert validated(server.bundles[-1]) == []


def test_results_wait_for_their_objects_to_be_in_the_archive(tmp_path: Path) -> None:
    with serving(tmp_path / "service", study_keys=[KEY]) as running:
        cloud_id = waiting_cloud(running)
        database = running.database
        assert add_notices(database, utc_now(), archived=True) == 0
        with database.session() as session:
            session.add(
                DicomSet(
                    id="dcs_1",
                    cloud_id=cloud_id,
                    options={},
                    first=True,
                    study_version=1,
                    state="waiting",
                    next_at=utc_now(),
                    held_until=utc_now(),
                    created_by="service",
                )
            )
        assert add_notices(database, utc_now(), archived=True) == 0
        with database.session() as session:
            session.get_one(DicomSet, "dcs_1").state = "sent"
        assert [add_notices(database, utc_now(), archived=True) for _ in range(2)] == [1, 0]
        with database.session() as session:
            assert session.get_one(FhirNotice, cloud_id).state == "pending"


def test_without_a_server_nothing_is_told(tmp_path: Path) -> None:
    with serving(tmp_path / "service", study_keys=[KEY]) as running:
        result = put_result(running, tmp_path / "result")
        asked = running.client().post(f"/v1/clouds/{result.cloud_id}/fhir")
        assert (asked.status_code, asked.json()["code"]) == (409, "fhir_server_missing")
