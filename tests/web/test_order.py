"""The order of an acquisition on the capture page: looked up in a real worklist, or entered by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from playwright.sync_api import expect

from tests.support.browser_scene import Window
from tests.support.hospital_scene import KEY
from tests.support.orthanc import orthanc
from tests.support.service_scene import serving
from tests.support.worklist_scene import write_entry


def test_an_order_is_chosen_or_entered(window: Window, tmp_path: Path) -> None:
    write_entry(tmp_path / "entries", "ACC1")
    options = {"Worklists": {"Enable": True, "Database": str(tmp_path / "entries")}}
    with orthanc(tmp_path / "orthanc", options=options) as worklist:
        place: dict[str, Any] = {
            "worklist_host": "127.0.0.1",
            "worklist_port": worklist.dicom_port,
            "worklist_ae_title": worklist.aet,
        }
        with serving(tmp_path / "service", study_keys=[KEY], **place) as service:
            page = window.page
            window.sign_in(service.url, service.key())
            page.goto(f"{service.url}/#/capture")
            page.get_by_test_id("new-specimen-id").fill("SP-1")
            page.get_by_test_id("create-acquisition").click()
            expect(page.get_by_role("heading", name="SP-1")).to_be_visible()
            acquisition = page.url.rpartition("/")[2]
            page.get_by_text("Order and patient").click()
            chosen = page.get_by_test_id("order-chosen")
            expect(chosen).to_have_text("No order is chosen yet.")
            page.get_by_label("Accession number", exact=True).fill("ACC1")
            page.get_by_test_id("order-find").click()
            page.get_by_test_id("order-choose").click(timeout=30_000)
            expect(chosen).to_have_text("Chosen: Doe, Jané, accession number ACC1")
            assert window.faults() == []
            path = f"/v1/acquisitions/{acquisition}/study"
            assert service.client().get(path).json()["study"]["specimen_identifier"] == "SPEC-ACC1"
            page.get_by_test_id("order-remove").click()
            expect(chosen).to_have_text("No order is chosen yet.")
            page.get_by_label("Patient id", exact=True).fill("P-7")
            page.get_by_label("Family name and given name").fill("Doe^John")
            page.get_by_label("Date of birth").fill("1960-05-06")
            page.get_by_test_id("order-hand").click()
            expect(chosen).to_have_text("Chosen: Doe, John, accession number ACC1")
            study = service.client().get(path).json()["study"]
            assert (study["patient_id"], study["patient_birth_date"]) == ("P-7", "1960-05-06")
            page.get_by_label("Language").select_option("it")
            expect(page.get_by_text("Richiesta e paziente")).to_be_visible()
