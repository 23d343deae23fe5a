"""Orders of real worklists and of a real DICOMweb server."""

from __future__ import annotations

import datetime
import logging
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from specimap_hospital.connections import PeerError
from specimap_hospital.orders.lookup import find_orders
from specimap_hospital.orders.model import MOST_ORDERS, OrderQuery
from specimap_hospital.outbox.archive import Stow
from specimap_hospital.outbox.rows import Claim
from specimap_infra.errors import OrderSourceUnavailableError
from specimap_infra.settings import ServiceSettings
from specimap_infra.study_context import StudyContext
from tests.support.hospital_scene import KEY
from tests.support.orthanc import RunningOrthanc, orthanc
from tests.support.outbox_scene import small_objects, with_settings
from tests.support.service_scene import serving
from tests.support.upload_scene import new_acquisition
from tests.support.worklist_scene import wlmscpfs, write_entry

pytestmark = pytest.mark.filterwarnings(
    # pynetdicom drops the socket of a connection that was refused without closing it.
    "ignore:Exception ignored in. <socket.socket:pytest.PytestUnraisableExceptionWarning"
)


@pytest.fixture(scope="module")
def worklist(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningOrthanc]:
    folder = tmp_path_factory.mktemp("worklist")
    entries = folder / "entries"
    write_entry(entries, "ACC1")
    write_entry(entries, "ACC2", patient="P-2", name="Doe^John", station="OTHER")
    for number in range(60):
        write_entry(entries, f"MANY{number}", patient="P-MANY")
    options = {"Worklists": {"Enable": True, "Database": str(entries)}}
    with orthanc(folder / "orthanc", options=options) as running:
        yield running


def settings_of(running: RunningOrthanc, tmp_path: Path, **given: object) -> ServiceSettings:
    place: dict[str, Any] = {"worklist_host": "127.0.0.1", "worklist_port": running.dicom_port}
    return with_settings(None, data_dir=tmp_path, worklist_ae_title=running.aet, **place, **given)


def test_an_order_is_found_by_its_accession_number_and_chosen(worklist: RunningOrthanc, tmp_path: Path) -> None:
    settings = settings_of(worklist, tmp_path)
    place = {name: getattr(settings, name) for name in ("worklist_host", "worklist_port", "worklist_ae_title")}
    with serving(tmp_path / "service", study_keys=[KEY], **place) as running:
        client = running.client(["upload"])
        answer = client.post("/v1/orders/search", json={"accession_number": "ACC1"})
        assert answer.status_code == 200, answer.text
        assert answer.headers["cache-control"] == "no-store"
        (order,) = answer.json()["orders"]
        assert (order["source"], order["station"], order["modality"]) == ("worklist", "SPECIMAP", "XC")
        assert (order["scheduled_at"], order["description"]) == ("2026-11-22T09:30:00", "Macroscopy")
        study = StudyContext.model_validate(order["study"])
        assert (study.accession_number, study.patient_id, study.patient_name) == ("ACC1", "P-1", "Doe^Jané")
        assert study.patient_birth_date == datetime.date(1951, 2, 3)
        assert (study.requested_procedure_id, study.scheduled_procedure_step_id) == ("RP-1", "SPS-1")
        assert (study.container_identifier, study.specimen_identifier) == ("CONT-ACC1", "SPEC-ACC1")
        assert (study.issuer_of_container_identifier, study.specimen_uid) == ("LAB", "2.25.4711")
        assert study.specimen_description == "Skin, left side"
        path = f"/v1/acquisitions/{new_acquisition(client)}/study"
        assert client.put(path, json=order["study"]).status_code == 200
        assert StudyContext.model_validate(client.get(path).json()["study"]) == study
        entries = running.client(["admin"]).get("/v1/audit").json()["items"]
        (entry,) = [entry for entry in entries if entry["action"] == "order.search"]
        assert entry["details"] == {"found": 1}
        assert running.client(["read"]).post("/v1/orders/search", json={"patient_id": "P-1"}).status_code == 403


@pytest.mark.parametrize(
    ("query", "found"),
    [
        ({"patient_id": "P-2"}, ["ACC2"]),
        ({"station": "OTHER"}, ["ACC2"]),
        ({"accession_number": "ACC1", "patient_id": "P-2"}, []),
        ({"accession_number": "NONE"}, []),
    ],
)
def test_orders_are_found_by_what_is_asked(
    worklist: RunningOrthanc, tmp_path: Path, query: dict[str, str], found: list[str]
) -> None:
    orders = find_orders(settings_of(worklist, tmp_path), OrderQuery(**query))
    assert [order.study.accession_number for order in orders.orders] == found
    assert not orders.more


def test_a_long_worklist_is_cut(worklist: RunningOrthanc, tmp_path: Path) -> None:
    orders = find_orders(settings_of(worklist, tmp_path), OrderQuery(patient_id="P-MANY"))
    assert (len(orders.orders), orders.more) == (MOST_ORDERS, True)


def test_the_worklist_of_dcmtk_is_understood_too(tmp_path: Path) -> None:
    write_entry(tmp_path / "lists" / "WORKLIST", "ACC9")
    with wlmscpfs(tmp_path / "lists") as port:
        settings = with_settings(
            None, data_dir=tmp_path, worklist_host="127.0.0.1", worklist_port=port, worklist_ae_title="WORKLIST"
        )
        (order,) = find_orders(settings, OrderQuery(accession_number="ACC9")).orders
    # It knows nothing of specimens.
    assert (order.study.patient_name, order.study.container_identifier) == ("Doe^Jané", "")
    assert (order.study.scheduled_procedure_step_id, order.modality) == ("SPS-1", "XC")


def test_studies_of_an_archive_are_orders_too(archive: RunningOrthanc, tmp_path: Path) -> None:
    place = {"pacs_url": archive.dicomweb_url, "pacs_user": archive.user, "pacs_password": archive.password}
    held = Claim("set", "cloud", {}, 1, "waiting", 1, "holder", None)
    with Stow(with_settings(None, data_dir=tmp_path, **place)) as stow:
        for made in small_objects(held, tmp_path, lambda: False, 2):
            stow.send(made)
    settings = with_settings(
        None,
        data_dir=tmp_path,
        orders_url=archive.dicomweb_url,
        orders_user=archive.user,
        orders_password=archive.password,
    )
    (order,) = find_orders(settings, OrderQuery(patient_id="V1")).orders
    assert (order.source, order.study.patient_name, order.study.patient_id) == ("qido", "Doe^Jane", "V1")
    assert order.study.study_instance_uid
    assert find_orders(settings, OrderQuery(station="ANY")).orders == []
    with pytest.raises(OrderSourceUnavailableError) as caught:
        find_orders(with_settings(settings, orders_password="wrong"), OrderQuery(patient_id="V1"))
    assert caught.value.details == {"source": "qido", "reason": "http_401"}


# ---- what goes wrong ----------------------------------------------------------------------------------


@pytest.mark.parametrize("query", [{}, {"patient_id": "*"}, {"accession_number": "A?"}, {"station": "A\\B"}])
def test_a_query_asks_for_something_and_not_for_all(worklist: RunningOrthanc, tmp_path: Path, query: Any) -> None:
    with serving(tmp_path / "service", worklist_host="127.0.0.1", worklist_ae_title="RIS") as running:
        answer = running.client().post("/v1/orders/search", json=query)
        assert (answer.status_code, answer.json()["code"]) == (422, "request_invalid")


def test_without_a_source_and_with_one_that_is_away(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with serving(tmp_path / "service") as running:
        answer = running.client().post("/v1/orders/search", json={"patient_id": "P-0815"})
        assert (answer.status_code, answer.json()["code"]) == (409, "order_source_missing")
    caplog.set_level(logging.DEBUG)
    worklist = {"worklist_host": "127.0.0.1", "worklist_port": 9, "worklist_ae_title": "RIS"}
    for given in (worklist, {"orders_url": "http://127.0.0.1:9/dicom-web"}):
        settings = with_settings(None, data_dir=tmp_path, **given)
        with pytest.raises(OrderSourceUnavailableError) as caught:
            find_orders(settings, OrderQuery(patient_id="P-0815"))
        assert caught.value.details["reason"] == "not_reachable"
        assert "P-0815" not in str(caught.value.as_dict())
    assert "P-0815" not in caplog.text


def test_a_source_that_does_not_answer_is_not_waited_for_long(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        held: list[socket.socket] = []
        threading.Thread(target=lambda: held.extend(silent.accept()[0] for _ in range(2)), daemon=True).start()
        port = silent.getsockname()[1]
        for given in (
            {"worklist_host": "127.0.0.1", "worklist_port": port, "worklist_ae_title": "RIS"},
            {"orders_url": f"http://127.0.0.1:{port}/dicom-web"},
        ):
            settings = with_settings(None, data_dir=tmp_path, orders_seconds=1.0, **given)
            start = time.monotonic()
            with pytest.raises(OrderSourceUnavailableError):
                find_orders(settings, OrderQuery(patient_id="P-1"))
            assert time.monotonic() - start < 30
        for connection in held:
            connection.close()


def test_reasons_are_codes_without_values() -> None:
    error = PeerError("http_503")
    assert (error.away, error.passing, str(error)) == (True, True, "http_503")
    assert not PeerError("failure_0110", passing=False).away
