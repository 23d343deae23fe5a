"""A real browser on the pages that a real service serves."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, BrowserType, Page, expect, sync_playwright

from bench.chromium import ARGUMENTS, chromium
from tests.support.places import ROOT, SAMPLES

PAGES = ROOT / "service" / "specimap_service" / "pages"
AXE = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"
SCREENSHOTS_VARIABLE = "BROWSER_SCREENSHOTS"
"""Where the pictures of the documents are made anew: BROWSER_SCREENSHOTS=docs/images."""
# The camera needs no permission.
OWN_ARGUMENTS = ("--use-fake-ui-for-media-stream", "--host-resolver-rules=MAP specimap.test 127.0.0.1")
PLAIN_HOST = "specimap.test"
"""This machine under a name that is no secure context on plain HTTP, unlike 127.0.0.1: much is missing there."""
TABLET = {"width": 1180, "height": 820}
SERIOUS = ("serious", "critical")


@dataclass
class Window:
    """A page of the browser, and what went wrong in it."""

    page: Page
    errors: list[str] = field(default_factory=list)

    def sign_in(self, url: str, key: str) -> None:
        """Open the pages and sign in."""
        self.page.goto(url)
        self.page.get_by_label("Key", exact=True).fill(key)
        self.page.get_by_role("button", name="Sign in", exact=True).click()
        expect(self.page.get_by_role("button", name="Sign out")).to_be_visible()

    def picture(self, name: str) -> bytes:
        """A picture of what is shown, kept in the folder of ``BROWSER_SCREENSHOTS`` if that is set."""
        picture = self.page.screenshot(animations="disabled")
        folder = os.environ.get(SCREENSHOTS_VARIABLE)
        if folder:
            Path(folder, f"{name}.png").write_bytes(picture)
        return picture

    def faults(self) -> list[str]:
        """Serious accessibility faults of what is shown, as axe finds them."""
        self.page.evaluate(AXE.read_text(encoding="utf-8"))
        found: dict[str, Any] = self.page.evaluate("axe.run(document, {resultTypes: ['violations']})")
        return [
            f"{fault['id']}: {fault['help']}: {[node['html'][:200] for node in fault['nodes']][:3]}"
            for fault in found["violations"]
            if fault["impact"] in SERIOUS
        ]


def browser_path() -> str:
    """The machine's Chromium; skips where there is none, and says how to get one."""
    found = chromium()
    if found is None:
        pytest.skip("there is no Chromium: apt-get install chromium, or name one in BROWSER_CHROMIUM")
    if not (PAGES / "index.html").is_file():
        pytest.skip("the web pages are not built: make pages")
    return found


def write_camera(path: Path) -> None:
    """Write what the browser's camera shows: the photos of the sample, a third of a second each, as Motion JPEG."""
    photos = [photo.read_bytes() for photo in sorted((SAMPLES / "rgb").glob("*.jpg"))]
    path.write_bytes(b"".join(photo * 10 for photo in photos))


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A headless browser, for a module: while one runs, the process has an event loop that other modules lack."""
    camera = tmp_path_factory.mktemp("camera") / "camera.mjpeg"
    browser_path()
    write_camera(camera)
    with sync_playwright() as playwright:
        started = launch(playwright.chromium, camera)
        yield started
        started.close()


def launch(chromium: BrowserType, camera: Path) -> Browser:
    """Start a browser whose camera shows a Motion JPEG file again and again."""
    fake = ("--use-fake-device-for-media-stream", f"--use-file-for-fake-video-capture={camera}")
    return chromium.launch(executable_path=browser_path(), args=[*ARGUMENTS, *OWN_ARGUMENTS, *fake])


@pytest.fixture
def context(browser: Browser) -> Iterator[BrowserContext]:
    """Cookies and storage of a test's own."""
    context = browser.new_context(viewport=TABLET, locale="en-GB", accept_downloads=True)  # type: ignore[arg-type]
    context.set_default_timeout(20_000)
    yield context
    context.close()


@pytest.fixture
def window(context: BrowserContext) -> Iterator[Window]:
    """A page; the test fails if a script in it does, or if the content-security policy refuses something."""
    window = Window(context.new_page())
    window.page.on("pageerror", lambda error: window.errors.append(f"{error.stack or error}"))
    window.page.on(
        "console",
        lambda said: window.errors.append(said.text) if "Content Security Policy" in said.text else None,
    )
    yield window
    assert window.errors == []
