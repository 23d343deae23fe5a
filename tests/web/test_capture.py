"""The capture page in a real browser: photos, cube, job; and that nothing is lost on the way."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Page, Route, expect

from tests.support.browser_scene import PLAIN_HOST, Window
from tests.support.places import SAMPLES
from tests.support.service_scene import Running
from tests.support.upload_scene import photos

CUBE = [SAMPLES / "hsi" / "hsi.hdr", SAMPLES / "hsi" / "hsi.raw"]
JUDGED_MS = 60_000
"""The first photo waits for the process that judges, and a busy machine for everything."""


def begin(window: Window, service: Running, specimen: str = "SP-1") -> str:
    """Sign in and create an acquisition; returns its id."""
    window.sign_in(service.url, service.key())
    window.page.goto(f"{service.url}/#/capture")
    return create(window.page, specimen)


def create(page: Page, specimen: str) -> str:
    page.get_by_test_id("new-specimen-id").fill(specimen)
    page.get_by_test_id("create-acquisition").click()
    expect(page.get_by_role("heading", name=specimen)).to_be_visible()
    return page.url.rpartition("/")[2]


def pick(page: Page, *paths: Path) -> None:
    page.get_by_test_id("pick-photos").set_input_files([str(path) for path in paths])


def expect_judged(page: Page, count: int) -> None:
    expect(page.get_by_test_id("photo-card")).to_have_count(count, timeout=JUDGED_MS)
    expect(page.get_by_test_id("pending-card")).to_have_count(0)


def test_photos_and_cube_become_a_job(service: Running, window: Window) -> None:
    page = window.page
    window.sign_in(service.url, service.key())
    page.goto(f"{service.url}/#/capture")
    expect(page.get_by_test_id("new-acquisition")).to_be_visible()
    assert window.faults() == []
    acquisition = create(page, "SP-2026-7")
    assert page.get_by_test_id("dome").get_attribute("data-covered") == "0"
    pick(page, *photos()[::3])
    page.get_by_test_id("cube-picker").set_input_files([str(path) for path in CUBE])
    expect_judged(page, 8)
    assert {card.get_attribute("data-verdict") for card in page.get_by_test_id("photo-card").all()} == {"accepted"}
    expect(page.get_by_test_id("cube-complete")).to_be_visible()
    expect(page.get_by_test_id("dome").locator("circle.spot")).to_have_count(8)
    expect(page.get_by_test_id("dome-next")).to_contain_text("Next:")
    expect(page.get_by_test_id("count")).to_have_text("8 of 20 photos")
    assert window.faults() == []
    page.get_by_test_id("start-job").click()
    expect(page.get_by_test_id("job-state")).to_have_attribute("data-state", "queued")
    (job,) = service.client().get("/v1/jobs", params={"acquisition_id": acquisition}).json()["items"]
    page.get_by_test_id("cancel-job").click()
    expect(page.get_by_test_id("job-state")).to_have_attribute("data-state", "cancelled")
    assert service.client().get(f"/v1/jobs/{job['id']}").json()["state"] == "cancelled"


def test_field_that_is_folded_away_is_shown_when_it_is_wrong(service: Running, window: Window) -> None:
    page = window.page
    window.sign_in(service.url, service.key())
    page.goto(f"{service.url}/#/capture")
    field = page.locator("#accession")
    page.locator("summary").click()
    field.fill("two words")
    page.locator("summary").click()
    expect(field).to_be_hidden()
    page.get_by_test_id("new-specimen-id").fill("SP-1")
    page.get_by_test_id("create-acquisition").click()
    expect(field).to_be_visible()


def test_acquisition_begins_where_the_browser_keeps_nothing(service: Running, window: Window) -> None:
    window.page.add_init_script(
        "Storage.prototype.setItem = () => { throw new DOMException('full', 'QuotaExceededError') }"
    )
    begin(window, service)


def test_many_markers_keep_within_the_page(service: Running, window: Window, tmp_path: Path) -> None:
    begin(window, service)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = np.full((1000, 1500), 255, np.uint8)
    for marker in range(24):
        row, column = divmod(marker, 6)
        x, y = 50 + 240 * column, 50 + 240 * row
        board[y : y + 180, x : x + 180] = cv2.aruco.generateImageMarker(dictionary, marker, 180)
    cv2.imwrite(str(tmp_path / "board.png"), board)
    pick(window.page, tmp_path / "board.png")
    expect_judged(window.page, 1)
    window.page.set_viewport_size({"width": 390, "height": 844})
    assert window.page.get_by_test_id("photo-card").locator(".ids").evaluate("e => e.children.length") == 24
    assert window.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    last = window.page.get_by_test_id("photo-card").locator(".ids > :last-child")
    assert last.evaluate("e => e.getBoundingClientRect().right <= innerWidth")


def test_the_whole_sample_is_enough(service: Running, window: Window) -> None:
    begin(window, service)
    pick(window.page, *photos())
    expect_judged(window.page, 24)
    expect(window.page.get_by_test_id("dome")).to_have_attribute("data-enough", "true")
    expect(window.page.get_by_test_id("advice")).to_contain_text("Enough photos")


def test_what_was_captured_without_a_network_is_sent_later(service: Running, window: Window) -> None:
    page = window.page
    begin(window, service)
    page.context.set_offline(True)
    pick(page, *photos()[:3])
    expect(page.get_by_test_id("notices")).to_contain_text("No connection")
    expect(page.get_by_test_id("pending-card")).to_have_count(3)
    page.context.set_offline(False)
    expect_judged(page, 3)


def test_a_reload_loses_nothing(service: Running, window: Window) -> None:
    page = window.page
    begin(window, service)

    def hold(route: Route) -> None:
        """Never answered: the page goes away meanwhile."""

    page.route("**/v1/uploads/*", hold)
    pick(page, *photos()[:2])
    expect(page.get_by_test_id("pending-card")).to_have_count(2)
    page.wait_for_timeout(500)
    page.unroute("**/v1/uploads/*", hold)
    page.reload()
    expect_judged(page, 2)
    expect(page.get_by_test_id("photo-card").locator("img")).to_have_count(2)


def test_photos_are_sent_from_an_address_without_tls(service: Running, window: Window) -> None:
    page, url = window.page, service.url.replace("127.0.0.1", PLAIN_HOST)
    window.sign_in(url, service.key())
    assert page.evaluate("isSecureContext") is False
    page.goto(f"{url}/#/capture")
    create(page, "SP-3")
    page.get_by_test_id("open-camera").click()
    expect(page.get_by_test_id("camera-trouble")).to_contain_text("https")
    pick(page, *photos()[:2])
    expect_judged(page, 2)


def test_a_lost_session_loses_nothing(service: Running, window: Window) -> None:
    page = window.page
    begin(window, service)
    page.context.clear_cookies()
    pick(page, photos()[0])
    expect(page.get_by_text("The session has ended")).to_be_visible()
    page.get_by_label("Key", exact=True).fill(service.key())
    page.get_by_role("button", name="Sign in").click()
    expect_judged(page, 1)


def test_a_full_disk_is_said_and_files_wait(service: Running, window: Window) -> None:
    page = window.page
    begin(window, service)
    problem = {"code": "storage_full", "detail": "The disk is nearly full.", "advice": "Wait.", "details": {}}

    def refuse(route: Route) -> None:
        route.fulfill(status=507, content_type="application/problem+json", body=json.dumps(problem))

    page.route("**/v1/uploads", refuse)
    pick(page, photos()[0])
    expect(page.get_by_test_id("notices")).to_contain_text("no room left")
    expect(page.get_by_test_id("pending-card")).to_have_attribute("data-state", "waiting")
    page.unroute("**/v1/uploads", refuse)
    page.get_by_test_id("notices").get_by_role("button").click()
    expect_judged(page, 1)


def test_files_that_are_no_photo_and_a_cube_without_its_header(
    service: Running, window: Window, tmp_path: Path
) -> None:
    page = window.page
    begin(window, service)
    for name, text in (("notes.pdf", "%PDF-1.4"), ("letter.jpg", "Dear colleague"), ("empty.jpg", "")):
        (tmp_path / name).write_text(text)
    pick(page, *(tmp_path / name for name in ("notes.pdf", "letter.jpg", "empty.jpg")))
    expect(page.get_by_test_id("no-photo")).to_contain_text("notes.pdf is no photo")
    expect(page.get_by_test_id("no-photo")).to_contain_text("empty.jpg is empty")
    expect(page.get_by_test_id("photo-card")).to_have_attribute("data-code", "photo_unreadable", timeout=JUDGED_MS)
    page.get_by_test_id("cube-picker").set_input_files(str(CUBE[1]))
    expect(page.get_by_test_id("cube-lacks")).to_contain_text("header (.hdr) is missing")
    page.get_by_test_id("cube-picker").set_input_files(str(CUBE[0]))
    expect(page.get_by_test_id("cube-complete")).to_be_visible()
    assert page.get_by_test_id("cube-lacks").count() == 0
    assert window.faults() == []


def test_data_shorter_than_the_header_says_are_told_before_they_are_sent(
    service: Running, window: Window, tmp_path: Path
) -> None:
    begin(window, service)
    (tmp_path / "hsi.hdr").write_bytes(CUBE[0].read_bytes())
    (tmp_path / "hsi.raw").write_bytes(CUBE[1].read_bytes()[:1000])
    window.page.get_by_test_id("cube-picker").set_input_files([str(tmp_path / "hsi.hdr"), str(tmp_path / "hsi.raw")])
    expect(window.page.get_by_test_id("cube-faults")).to_contain_text("was not copied whole")


def test_one_tap_takes_a_refused_photo_again(service: Running, window: Window, tmp_path: Path) -> None:
    page = window.page
    begin(window, service)
    (tmp_path / "letter.jpg").write_text("Dear colleague")
    pick(page, tmp_path / "letter.jpg")
    page.get_by_test_id("retake").click(timeout=JUDGED_MS)
    expect(page.get_by_test_id("photo-card")).to_have_count(0)
    shutter = page.get_by_test_id("shutter")
    expect(shutter).to_be_enabled()
    assert window.faults() == []
    shutter.click()
    # Frames may be caught between two photos of the sample.
    usable = re.compile("accepted|doubtful")
    expect(page.get_by_test_id("photo-card")).to_have_attribute("data-verdict", usable, timeout=JUDGED_MS)
    expect(page.get_by_test_id("last-verdict")).to_contain_text(re.compile("good|better again"))


def test_a_better_photo_takes_the_place_of_a_doubtful_one(service: Running, window: Window, tmp_path: Path) -> None:
    page = window.page
    acquisition = begin(window, service)
    dark = np.asarray(cv2.imread(str(photos()[0])), np.uint8) // 8
    assert cv2.imwrite(str(tmp_path / "dark.jpg"), dark)
    pick(page, tmp_path / "dark.jpg")
    expect(page.get_by_test_id("photo-card")).to_have_attribute("data-code", "photo_underexposed", timeout=JUDGED_MS)
    page.get_by_test_id("retake").click()
    # It stays until the better one is there.
    expect(page.get_by_test_id("shutter")).to_be_enabled()
    expect(page.get_by_test_id("photo-card")).to_have_attribute("data-verdict", "doubtful")
    with page.expect_response(lambda answer: "/result" in answer.url) as judged:
        page.get_by_test_id("shutter").click()
    # A frame may be caught between two photos of the sample: then both stay.
    better = judged.value.json()["file"]["judgement"]["verdict"] == "accepted"
    expect(page.get_by_test_id("photo-card")).to_have_count(1 if better else 2, timeout=JUDGED_MS)
    assert len(service.client().get(f"/v1/acquisitions/{acquisition}/files").json()) == (1 if better else 2)


@pytest.mark.parametrize(("name", "said"), [("NotAllowedError", "blocked"), ("NotFoundError", "no camera")])
def test_a_camera_that_cannot_be_used_is_said(service: Running, window: Window, name: str, said: str) -> None:
    page = window.page
    page.add_init_script(
        f"navigator.mediaDevices.getUserMedia = () => Promise.reject(new DOMException('no', '{name}'));"
    )
    begin(window, service)
    page.get_by_test_id("open-camera").click()
    expect(page.get_by_test_id("camera-trouble")).to_contain_text(said)
    expect(page.get_by_test_id("pick-photos")).to_be_attached()


def test_a_barcode_gives_the_specimens_id(service: Running, window: Window) -> None:
    page = window.page
    page.add_init_script(
        "globalThis.BarcodeDetector = class { async detect() { return [{rawValue: 'SP-2026-0117'}]; } };"
    )
    window.sign_in(service.url, service.key())
    page.goto(f"{service.url}/#/capture")
    page.get_by_test_id("scan-barcode").click()
    expect(page.get_by_test_id("new-specimen-id")).to_have_value("SP-2026-0117")


def test_scripts_of_the_capture_page_stay_within_their_budget(service: Running, window: Window) -> None:
    page = window.page
    sizes: dict[str, int] = {}
    page.on("response", lambda answer: sizes.update({answer.url: len(answer.body())} if ".js" in answer.url else {}))
    begin(window, service)
    scripts = {url: size for url, size in sizes.items() if "/assets/" in url and "sw.js" not in url}
    assert 100_000 < sum(scripts.values()) < 250_000
