"""A real browser on the pages that a real service serves."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright

from tests.support.places import ROOT

PAGES = ROOT / "service" / "specimap_service" / "pages"
AXE = ROOT / "web" / "node_modules" / "axe-core" / "axe.min.js"
CHROMIUM_VARIABLE = "SPECIMAP_CHROMIUM"
NAMES = ("chromium", "chromium-browser", "google-chrome")
# Chromium looks for updates and translations elsewhere unless it is told not to; WebGL is drawn by software.
ARGUMENTS = (
    "--no-sandbox",
    "--no-first-run",
    "--disable-quic",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)
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
        self.page.get_by_role("button", name="Sign in").click()
        expect(self.page.get_by_role("button", name="Sign out")).to_be_visible()

    def faults(self) -> list[str]:
        """Serious accessibility faults of what is shown, as axe finds them."""
        self.page.evaluate(AXE.read_text(encoding="utf-8"))
        found: dict[str, Any] = self.page.evaluate("axe.run(document, {resultTypes: ['violations']})")
        return [
            f"{fault['id']}: {fault['help']}: {[node['html'][:200] for node in fault['nodes']][:3]}"
            for fault in found["violations"]
            if fault["impact"] in SERIOUS
        ]


def chromium() -> str:
    """The machine's Chromium; skips where there is none, and says how to get one."""
    given = os.environ.get(CHROMIUM_VARIABLE)
    found = given or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip("there is no Chromium: apt-get install chromium, or name one in SPECIMAP_CHROMIUM")
    if not (PAGES / "index.html").is_file():
        pytest.skip("the web pages are not built: make pages")
    return found


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """A headless browser, for a module: while one runs, the process has an event loop that other modules lack."""
    path = chromium()
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield started
        started.close()


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
    window.page.on("pageerror", lambda error: window.errors.append(str(error)))
    window.page.on(
        "console",
        lambda said: window.errors.append(said.text) if "Content Security Policy" in said.text else None,
    )
    yield window
    assert window.errors == []


def screenshot(window: Window, name: str, folder: Path | None) -> bytes:
    """A picture of what is shown; kept in ``folder`` if given."""
    picture = window.page.screenshot(animations="disabled")
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.png").write_bytes(picture)
    return picture
