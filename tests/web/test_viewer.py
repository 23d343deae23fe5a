"""The viewer in a real browser: what it shows is what the cloud holds."""

from __future__ import annotations

import csv
import datetime
import io
import re
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from playwright.sync_api import Page, expect

import specimap_client as sc
from specimap_infra.database import utc_now
from tests.support.browser_scene import Window
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


def open_viewer(window: Window, url: str, key: str, result: Result, state: str = "") -> Page:
    page = window.page
    window.sign_in(url, key)
    page.goto(f"{url}/#/view/{result.cloud_id}{state}")
    expect(page.get_by_test_id("viewer-canvas")).to_have_attribute("data-state", "ready", timeout=60_000)
    return page


def place_of(page: Page, index: int) -> tuple[float, float]:
    at = page.evaluate(f"window.specimapViewer.project({index})")
    assert at is not None
    return at["x"], at["y"]


def tap(page: Page, index: int) -> None:
    page.mouse.click(*place_of(page, index))


def downloaded_spectra(page: Page) -> list[list[str]]:
    with page.expect_download() as download:
        page.get_by_test_id("spectra-csv").click()
    return list(csv.reader(download.value.path().read_text("utf-8-sig").splitlines()))


def test_tapped_point_shows_the_spectrum_of_the_cube(service: Running, window: Window, result: Result) -> None:
    page, cloud = open_viewer(window, service.url, service.key(), result), result.cloud
    assert page.get_by_test_id("viewer-canvas").get_attribute("data-points") == str(cloud.n_points)
    assert window.faults() == []
    # In the middle, where no neighbour lies in front.
    middle = int(np.argmin(np.linalg.norm(cloud.xyz[:, :2] - cloud.xyz[:, :2].mean(0), axis=1)))
    tap(page, middle)
    expect(page.get_by_test_id("spectrum-plot")).to_be_visible()
    text = page.get_by_test_id("point-details").inner_text()
    row, column = (int(n) for n in re.search(r"(\d+)\D+(\d+)\D*$", text).groups())  # type: ignore[union-attr]
    (index,) = np.flatnonzero((cloud.hsi_pixel == [row, column]).all(1))
    assert np.linalg.norm(cloud.xyz[index] - cloud.xyz[middle]) < 1.0
    rows = downloaded_spectra(page)
    assert [float(line[1]) for line in rows[1:]] == pytest.approx(list(cloud.wavelengths_nm), abs=0.01)
    spectrum = cloud.spectra([int(index)])[0]
    shown = np.array([float(line[2]) if line[2] else np.nan for line in rows[1:]])
    np.testing.assert_allclose(shown, spectrum, atol=2e-4)
    assert np.nanmax(spectrum) > 0.01
    assert window.faults() == []


def test_every_colouring_shows_a_picture_of_its_own(service: Running, window: Window, result: Result) -> None:
    page = open_viewer(window, service.url, service.key(), result)
    canvas, pictures = page.get_by_test_id("viewer-canvas"), set[bytes]()
    for mode in ("photo", "height", "sigma", "band", "pca"):
        page.get_by_test_id("colour-mode").select_option(mode)
        deadline = time.monotonic() + 10
        while (picture := canvas.screenshot()) in pictures:
            assert time.monotonic() < deadline, f"{mode} looks like another colouring"
            page.wait_for_timeout(100)
        pictures.add(picture)
    assert window.faults() == []


def test_height_is_coloured_as_the_colour_bar_says(service: Running, window: Window, result: Result) -> None:
    page, cloud = open_viewer(window, service.url, service.key(), result), result.cloud
    page.get_by_test_id("colour-mode").select_option("height")
    expect(page.get_by_test_id("colour-bar")).to_be_visible()
    page.wait_for_timeout(500)
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(float)
    z = cloud.xyz[:, 2]
    # The upper end of viridis on the summit, which nothing hides, and a darker green half-way.
    yellow, summit = np.array([253, 231, 37]), int(np.argmax(z))
    # Half-way down, the one nearest to the summit.
    level = np.abs(z - np.quantile(z, 0.6)) < 0.1
    slope = int(np.argmin(np.where(level, np.linalg.norm(cloud.xyz - cloud.xyz[summit], axis=1), np.inf)))
    off = []
    for index in (summit, slope):
        x, y = place_of(page, index)
        around = picture[int(y) - 3 : int(y) + 4, int(x) - 3 : int(x) + 4].reshape(-1, 3)
        off.append(float(np.median(np.abs(around - yellow).sum(1))))
    assert off[0] < 60, off
    assert off[1] > off[0] + 30, off


def test_link_opens_the_same_view(service: Running, window: Window, result: Result) -> None:
    key = service.key()
    page = open_viewer(window, service.url, key, result)
    page.get_by_test_id("colour-mode").select_option("band")
    page.get_by_test_id("band-slider").fill("4")
    canvas = page.get_by_test_id("viewer-canvas")
    canvas.focus()
    for _ in range(3):
        page.keyboard.press("ArrowLeft")
    page.wait_for_timeout(800)
    address, index = page.url, 500
    assert "spk_" not in address
    before = place_of(page, index)
    page.goto("about:blank")
    page.goto(address)
    expect(page.get_by_test_id("viewer-canvas")).to_have_attribute("data-state", "ready", timeout=60_000)
    expect(page.get_by_test_id("colour-mode")).to_have_value("band")
    expect(page.get_by_test_id("band-slider")).to_have_value("4")
    page.wait_for_timeout(500)
    assert place_of(page, index) == pytest.approx(before, abs=1.5)


def test_labels_are_painted_saved_and_read_back_by_a_program(service: Running, window: Window, result: Result) -> None:
    key = service.key()
    page, cloud = open_viewer(window, service.url, key, result), result.cloud
    page.get_by_test_id("panel-labels").locator("summary").click()
    page.get_by_test_id("new-layer").fill("margin")
    page.get_by_test_id("begin-layer").click()
    page.get_by_test_id("paint-tool").select_option("brush")
    page.get_by_test_id("brush-radius").fill("2")
    page.get_by_test_id("brush-radius").blur()
    middle = int(np.argmin(np.linalg.norm(cloud.xyz[:, :2] - cloud.xyz[:, :2].mean(0), axis=1)))
    tap(page, middle)
    expect(page.get_by_test_id("undo")).to_be_enabled()
    page.get_by_test_id("undo").click()
    expect(page.get_by_test_id("undo")).to_be_disabled()
    page.get_by_test_id("redo").click()
    page.get_by_test_id("save-labels").click()
    expect(page.get_by_test_id("save-status")).to_contain_text("1", timeout=15_000)
    assert window.faults() == []
    with sc.Client(service.url, key) as client:
        read = client.clouds.get(result.cloud_id)
        values = np.asarray(read.label("margin").values())
    painted = np.flatnonzero(values == 1)
    distance = np.linalg.norm(cloud.xyz - cloud.xyz[middle], axis=1)
    assert 3 < len(painted) < 0.5 * len(values)
    # The brush's centre is the point that was hit, which lies within a pixel's breadth of the middle.
    assert distance[painted].max() < 3.0
    assert set(np.flatnonzero(distance < 1.0)) <= set(painted)


def test_labels_that_are_not_saved_outlive_a_walk_to_another_page(
    service: Running, window: Window, result: Result
) -> None:
    key = service.key()
    page = open_viewer(window, service.url, key, result)
    page.get_by_test_id("panel-labels").locator("summary").click()
    page.get_by_test_id("new-layer").fill("margin")
    page.get_by_test_id("begin-layer").click()
    page.get_by_test_id("paint-tool").select_option("brush")
    page.get_by_test_id("brush-radius").fill("1")
    page.get_by_test_id("brush-radius").blur()
    tap(page, 1800)
    expect(page.get_by_test_id("save-labels")).to_be_enabled()
    # The session ends, somebody signs in again, and goes back by way of another page.
    page.context.clear_cookies()
    page.get_by_role("link", name="Jobs").click()
    page.get_by_label("Key", exact=True).fill(key)
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("heading", name="Jobs")).to_be_visible()
    page.evaluate("place => { location.hash = place }", f"#/view/{result.cloud_id}")
    expect(page.get_by_test_id("viewer-canvas")).to_have_attribute("data-state", "ready", timeout=60_000)
    page.get_by_test_id("layer").select_option("margin")
    page.get_by_test_id("panel-labels").locator("summary").click()
    expect(page.get_by_test_id("undo")).to_be_enabled()
    page.get_by_test_id("save-labels").click()
    expect(page.get_by_test_id("save-status")).to_contain_text("1", timeout=15_000)
    with sc.Client(service.url, key) as client:
        values = np.asarray(client.clouds.get(result.cloud_id).label("margin").values())
    assert values[1800] == 1


def test_labels_that_a_program_changed_meanwhile_are_not_overwritten(
    service: Running, window: Window, result: Result
) -> None:
    key = service.key()
    with sc.Client(service.url, key) as client:
        cloud = client.clouds.get(result.cloud_id)
        classes = [sc.LabelClass(value=0, name="unlabelled"), sc.LabelClass(value=1, name="tumour", colour="#d62728")]
        cloud.put_label("model", np.zeros(cloud.points, np.uint8), classes=classes, made_by="net")
        page = open_viewer(window, service.url, key, result)
        page.get_by_test_id("layer").select_option("model")
        page.get_by_test_id("panel-labels").locator("summary").click()
        page.get_by_test_id("paint-tool").select_option("brush")
        tap(page, 1800)
        theirs = np.ones(cloud.points, np.uint8)
        cloud.put_label("model", theirs, classes=classes, made_by="net")
        page.get_by_test_id("save-labels").click()
        expect(page.get_by_test_id("label-conflict")).to_be_visible()
        assert np.asarray(cloud.label("model").values()).all()
        page.get_by_test_id("keep-mine").click()
        expect(page.get_by_test_id("save-status")).to_contain_text("3", timeout=15_000)
        assert 0 < np.asarray(cloud.label("model").values()).sum() < cloud.points


def test_shared_link_shows_this_cloud_alone_until_it_is_revoked(
    service: Running, window: Window, result: Result
) -> None:
    page = open_viewer(window, service.url, service.key(), result)
    page.get_by_test_id("panel-share").locator("summary").click()
    page.get_by_test_id("share-name").fill("tumour board")
    page.get_by_test_id("share-create").click()
    shown = page.get_by_test_id("share-link")
    link = shown.input_value() if shown.evaluate("e => 'value' in e") else shown.inner_text()
    assert re.search(r"#/shared/sps_[0-9a-z]+_[0-9a-f]+", link)
    assert window.faults() == []
    guest = page.context.browser.new_context()  # type: ignore[union-attr]
    try:
        visitor = guest.new_page()
        visitor.goto(link.strip())
        canvas = visitor.get_by_test_id("viewer-canvas")
        expect(canvas).to_have_attribute("data-state", "ready", timeout=60_000)
        assert "sps_" not in visitor.url
        assert visitor.get_by_test_id("panel-share").count() == 0
        assert visitor.get_by_test_id("panel-labels").count() == 0
        assert visitor.get_by_role("link", name="Jobs").count() == 0
        assert visitor.evaluate("fetch('v1/jobs').then(r => r.status)") in (403, 404)
        page.on("dialog", lambda dialog: dialog.accept())
        page.get_by_test_id("share-revoke").first.click()
        expect(page.get_by_test_id("shares")).to_contain_text(re.compile("ended|revoked"))
        visitor.wait_for_timeout(2500)
        visitor.reload()
        expect(visitor.get_by_test_id("viewer-canvas")).to_have_count(0)
        visitor.goto(link.strip())
        expect(visitor.get_by_role("alert")).to_contain_text("not valid")
        assert "sps_" not in visitor.url
    finally:
        guest.close()


def test_shared_link_takes_no_session_away_unasked(service: Running, window: Window, result: Result) -> None:
    ends = (utc_now() + datetime.timedelta(days=1)).isoformat()
    made = service.client().post(
        f"/v1/clouds/{result.cloud_id}/shares", json={"name": "tumour board", "expires_at": ends}
    )
    page = window.page
    window.sign_in(service.url, service.key())
    page.goto(f"{service.url}/#/shared/{made.json()['token']}")
    expect(page.get_by_test_id("open-shared")).to_be_visible()
    assert window.faults() == []
    page.get_by_role("button", name="Stay signed in").click()
    expect(page.get_by_role("heading", name="Acquisitions")).to_be_visible()
    page.goto(f"{service.url}/#/shared/{made.json()['token']}")
    page.get_by_test_id("open-shared").click()
    expect(page.get_by_test_id("viewer-canvas")).to_have_attribute("data-state", "ready", timeout=60_000)
    # Wherever the address leads, the result is what there is to see.
    page.get_by_role("link", name="Specimap").click()
    expect(page).to_have_url(re.compile(f"#/view/{result.cloud_id}"))
    page.goto(f"{service.url}/#/admin")
    expect(page.get_by_test_id("viewer-canvas")).to_be_visible()


def test_report_stays_within_its_panel(service: Running, window: Window, result: Result) -> None:
    page = open_viewer(window, service.url, service.key(), result)
    panel = page.get_by_test_id("panel-quality")
    panel.locator("summary").click()
    expect(panel.get_by_role("cell").first).to_be_visible()
    page.set_viewport_size({"width": 390, "height": 844})
    for _ in range(2):
        right, width = panel.locator("table").evaluate("e => [e.getBoundingClientRect().right, innerWidth]")
        assert right <= width
        page.set_viewport_size({"width": 1180, "height": 820})


def test_scripts_before_the_first_picture_stay_within_their_budget(
    service: Running, window: Window, result: Result
) -> None:
    sizes: dict[str, int] = {}
    # Notes when the canvas leaves the state of loading.
    window.page.add_init_script(
        """new MutationObserver(() => {
            const canvas = document.querySelector('[data-testid=viewer-canvas]');
            if (canvas && canvas.dataset.state !== 'loading') window.pictureAt ??= performance.now();
        }).observe(document, { subtree: true, childList: true, attributes: true })"""
    )
    window.page.on("response", lambda answer: sizes.__setitem__(answer.url, len(answer.body())))
    page = open_viewer(window, service.url, service.key(), result)
    page.wait_for_timeout(500)
    scripts = page.evaluate(
        """performance.getEntriesByType('resource')
            .filter(({ name, startTime }) => name.endsWith('.js') && startTime < window.pictureAt)
            .map(({ name }) => name)"""
    )
    total = sum(sizes[name] for name in scripts)
    assert 300_000 < total < 600_000, {name: sizes[name] for name in scripts}


def test_cloud_that_is_gone_is_said(service: Running, window: Window, result: Result) -> None:
    page = window.page
    window.sign_in(service.url, service.key())
    page.goto(f"{service.url}/#/view/cloud_00000000000000000000000000")
    expect(page.get_by_role("alert")).to_contain_text("There is no cloud")
