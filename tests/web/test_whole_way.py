"""The whole way in a browser: capture with a network that fails, job, result, spectrum, labels, download."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from playwright.sync_api import Page, expect

import specimap_client as sc
from tests.support.browser_scene import Window
from tests.support.places import SAMPLES
from tests.support.scenes import OnDisk
from tests.support.serve_scene import Served, running

COLUMNS = 464
"""Of the sample's cube."""
pytestmark = [pytest.mark.slow, pytest.mark.waits]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with running(tmp_path / "data") as served:
        yield served


def new_acquisition(page: Page, specimen: str) -> None:
    page.get_by_test_id("new-acquisition").click()
    page.get_by_test_id("new-specimen-id").fill(specimen)
    page.get_by_test_id("create-acquisition").click()
    expect(page.get_by_test_id("capture")).to_be_visible()


def test_specimen_is_captured_in_spite_of_the_network_and_becomes_a_cloud(served: Served, window: Window) -> None:
    url, key, page = served.printed("Specimap listens on "), "spk_" + served.printed("spk_"), window.page
    window.sign_in(url, key)
    new_acquisition(page, "S-2026-7")
    assert window.faults() == []
    photos = sorted((SAMPLES / "rgb").glob("*.jpg"))
    page.get_by_test_id("pick-photos").set_input_files(photos[:4])
    expect(page.get_by_test_id("photo-card")).to_have_count(4, timeout=60_000)
    # The network goes; photos taken meanwhile are kept, over a reload too, and sent when it is back.
    page.context.set_offline(True)
    page.get_by_test_id("pick-photos").set_input_files(photos[4:])
    expect(page.get_by_test_id("notices")).to_contain_text("No connection")
    expect(page.get_by_test_id("pending-card")).to_have_count(len(photos) - 4, timeout=30_000)
    page.context.set_offline(False)
    page.reload()
    expect(page.get_by_test_id("photo-card")).to_have_count(len(photos), timeout=120_000)
    expect(page.get_by_test_id("pending-card")).to_have_count(0)
    assert float(page.get_by_test_id("dome").get_attribute("data-covered") or 0) > 0.2
    # Header and data one after the other: the page says what is missing.
    header = SAMPLES / "hsi" / "hsi.hdr"
    (data,) = (path for path in header.parent.iterdir() if path != header)
    page.get_by_test_id("cube-picker").set_input_files(header)
    expect(page.get_by_test_id("cube-lacks")).to_contain_text("data")
    page.get_by_test_id("cube-picker").set_input_files(data)
    expect(page.get_by_test_id("cube-complete")).to_be_visible(timeout=60_000)
    assert window.faults() == []
    window.picture("web-capture")
    page.get_by_test_id("start-job").click()
    expect(page.get_by_test_id("job-state")).to_have_attribute("data-state", "succeeded", timeout=180_000)
    page.get_by_test_id("view-cloud").click()
    expect(page).to_have_url(re.compile("#/view/cloud_"))
    canvas = page.get_by_test_id("viewer-canvas")
    expect(canvas).to_have_attribute("data-state", "ready", timeout=60_000)
    assert int(canvas.get_attribute("data-points") or 0) > 100_000
    assert window.faults() == []
    with sc.Client(url, key) as client:
        (cloud,) = client.clouds.list()
        top = int(np.argmax(np.where(cloud.flags & 1, cloud.xyz[:, 2], -np.inf)))
        at = page.evaluate(f"window.specimapViewer.project({top})")
        page.mouse.click(at["x"], at["y"])
        expect(page.get_by_test_id("spectrum-plot")).to_be_visible()
        row, column = (int(n) for n in re.findall(r"\d+", page.get_by_test_id("point-details").inner_text())[-2:])
        (index,) = np.flatnonzero((cloud.hsi_pixel == [row, column]).all(1))
        assert np.linalg.norm(cloud.xyz[index] - cloud.xyz[top]) < 1.5
        with page.expect_download() as download:
            page.get_by_test_id("spectra-csv").click()
        lines = list(csv.reader(download.value.path().read_text("utf-8-sig").splitlines()))[1:]
        shown = [float(line[2]) for line in lines]
        # What the browser shows is what the uploaded file holds.
        values = np.fromfile(data, "<u2").reshape(cloud.bands, -1, COLUMNS)[:, row, column]
        np.testing.assert_allclose(shown, values * 1e-4, atol=1.01e-4)
    page.get_by_test_id("spectrum-plot").scroll_into_view_if_needed()
    window.picture("web-viewer")


def test_photos_are_taken_with_the_camera_of_the_tablet(served: Served, window: Window) -> None:
    url, key, page = served.printed("Specimap listens on "), "spk_" + served.printed("spk_"), window.page
    page.context.grant_permissions(["camera"])
    window.sign_in(url, key)
    new_acquisition(page, "S-10")
    page.get_by_test_id("open-camera").click()
    card, shutter = page.get_by_test_id("photo-card"), page.get_by_test_id("shutter")
    expect(shutter).to_be_enabled()
    for count in (1, 2, 3):
        page.wait_for_timeout(700)
        shutter.click()
        expect(card).to_have_count(count, timeout=30_000)
    assert window.faults() == []
    with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, trust_env=False) as client:
        (acquisition,) = client.get("/v1/acquisitions").json()["items"]
        files = client.get(f"/v1/acquisitions/{acquisition['id']}/files").json()
    assert [file["state"] for file in files] == ["accepted"] * 3
    for file in files:
        assert {0, 1, 2, 3} >= set(file["judgement"]["marker_ids"])
        assert len(file["judgement"]["marker_ids"]) >= 2


def test_upload_goes_on_when_the_service_starts_again(window: Window, small: OnDisk, tmp_path: Path) -> None:
    page, photos = window.page, sorted((small.folder / "rgb").iterdir())[:6]
    with running(tmp_path / "data") as first:
        url, key = first.printed("Specimap listens on "), "spk_" + first.printed("spk_")
        window.sign_in(url, key)
        new_acquisition(page, "S-9")
        page.get_by_test_id("pick-photos").set_input_files(photos[:2])
        expect(page.get_by_test_id("photo-card")).to_have_count(2, timeout=60_000)
    page.get_by_test_id("pick-photos").set_input_files(photos[2:])
    expect(page.get_by_test_id("notices")).to_contain_text("does not answer", timeout=30_000)
    with running(tmp_path / "data", SPECIMAP_PORT=url.rpartition(":")[2]) as again:
        again.printed("Specimap listens on ")
        expect(page.get_by_test_id("photo-card")).to_have_count(6, timeout=90_000)
        with httpx.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, trust_env=False) as client:
            (acquisition,) = client.get("/v1/acquisitions").json()["items"]
            assert acquisition["files"]["photos"] == 6
