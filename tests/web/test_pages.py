"""The pages around capture and viewer, in a real browser: sign-in, lists, jobs, results, administration."""

from __future__ import annotations

import re
from pathlib import Path

from playwright.sync_api import expect

from tests.support.browser_scene import Window
from tests.support.result_scene import put_result
from tests.support.service_scene import Running


def test_person_signs_in_with_a_key_that_stays_nowhere(service: Running, window: Window) -> None:
    page, key = window.page, service.key()
    page.goto(service.url)
    page.get_by_label("Key", exact=True).fill("spk_wrong_key")
    page.get_by_role("button", name="Sign in").click()
    expect(page.get_by_role("alert")).to_contain_text("not valid")
    window.sign_in(service.url, key)
    cookies = page.context.cookies()
    assert [(c["name"], c["httpOnly"], c["sameSite"]) for c in cookies] == [("specimap_session", True, "Strict")]
    kept = page.evaluate("JSON.stringify([{...localStorage}, {...sessionStorage}, document.cookie, location.href])")
    assert key not in kept
    assert key not in cookies[0]["value"]
    page.reload()
    expect(page.get_by_role("heading", name="Acquisitions")).to_be_visible()
    page.get_by_role("button", name="Sign out").click()
    expect(page.get_by_label("Key", exact=True)).to_be_visible()
    assert page.context.cookies() == []


def test_session_that_ends_meanwhile_is_said(service: Running, window: Window) -> None:
    page = window.page
    window.sign_in(service.url, service.key())
    expect(page.get_by_text("There is no acquisition yet.")).to_be_visible()
    page.context.clear_cookies()
    page.get_by_role("link", name="Jobs").click()
    expect(page.get_by_text("The session has ended")).to_be_visible()


def test_pages_speak_italian_and_remember_it(service: Running, window: Window) -> None:
    page = window.page
    page.goto(service.url)
    page.get_by_label("Language").select_option("it")
    expect(page.get_by_role("heading", name="Accesso")).to_be_visible()
    page.reload()
    expect(page.get_by_role("heading", name="Accesso")).to_be_visible()
    assert page.evaluate("document.documentElement.lang") == "it"


def test_result_is_found_from_every_list(service: Running, window: Window, tmp_path: Path) -> None:
    result = put_result(service, tmp_path / "result", specimen_id="S-77")
    page = window.page
    window.sign_in(service.url, service.key())
    assert window.faults() == []
    row = page.get_by_test_id("acquisitions").get_by_role("row").filter(has_text="S-77")
    row.get_by_role("link").click()
    expect(page.get_by_role("heading", name="Specimen S-77")).to_be_visible()
    expect(page.get_by_test_id("jobs")).to_contain_text("finished")
    assert window.faults() == []
    page.get_by_test_id("jobs").get_by_role("link").first.click()
    expect(page.get_by_test_id("job")).to_have_attribute("data-state", "succeeded")
    expect(page.get_by_test_id("report")).to_be_visible()
    assert page.get_by_test_id("open-viewer").get_attribute("href") == f"#/view/{result.cloud_id}"
    assert window.faults() == []
    page.get_by_role("link", name="Results").click()
    expect(page.get_by_test_id("results")).to_contain_text(re.compile(r"\d"))
    assert page.locator(f'a[href="#/view/{result.cloud_id}"]').count() == 2
    assert window.faults() == []


def test_search_finds_a_specimen(service: Running, window: Window, tmp_path: Path) -> None:
    for name in ("S-1", "S-2"):
        put_result(service, tmp_path / name, specimen_id=name)
    page = window.page
    window.sign_in(service.url, service.key())
    expect(page.get_by_test_id("acquisitions").get_by_role("row")).to_have_count(3)
    page.get_by_label("Specimen id").fill("S-2")
    page.get_by_role("button", name="Search").click()
    expect(page.get_by_test_id("acquisitions").get_by_role("row")).to_have_count(2)
    expect(page.get_by_test_id("acquisitions")).to_contain_text("S-2")


def test_administrator_makes_and_revokes_a_key(service: Running, window: Window) -> None:
    page = window.page
    window.sign_in(service.url, service.key())
    page.get_by_role("link", name="Administration").click()
    page.get_by_text("New key").click()
    page.get_by_label("Name").fill("tablet 3")
    page.get_by_role("button", name="Create").first.click()
    key = page.get_by_test_id("new-key").inner_text()
    assert re.fullmatch(r"spk_[0-9a-z]{26}_[0-9a-f]{64}", key)
    row = page.get_by_test_id("keys").get_by_role("row").filter(has_text="tablet 3")
    expect(row).to_contain_text("valid")
    assert window.faults() == []
    page.on("dialog", lambda dialog: dialog.accept())
    row.get_by_role("button", name="Revoke").click()
    expect(row).to_contain_text("revoked")
    expect(page.get_by_test_id("audit")).to_be_visible()


def test_key_without_rights_sees_neither_administration_nor_changes(
    service: Running, window: Window, tmp_path: Path
) -> None:
    put_result(service, tmp_path / "result")
    page = window.page
    window.sign_in(service.url, service.key(["read"]))
    expect(page.get_by_test_id("acquisitions")).to_be_visible()
    assert page.get_by_role("link", name="Administration").count() == 0
    assert page.get_by_test_id("new-acquisition").count() == 0
    page.goto(f"{service.url}/#/admin")
    expect(page.get_by_role("alert").first).to_contain_text("lacks the right")


def test_page_goes_on_after_the_connection_was_lost(service: Running, window: Window, tmp_path: Path) -> None:
    page = window.page
    window.sign_in(service.url, service.key())
    expect(page.get_by_text("There is no acquisition yet.")).to_be_visible()
    page.context.set_offline(True)
    page.get_by_role("link", name="Jobs").click()
    expect(page.get_by_role("alert")).to_contain_text("No connection")
    page.context.set_offline(False)
    put_result(service, tmp_path / "result")
    page.get_by_role("button", name="Try again").click()
    expect(page.get_by_test_id("jobs")).to_contain_text("finished")
