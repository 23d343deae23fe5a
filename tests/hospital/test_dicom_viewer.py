"""The objects in the OHIF viewer, in a real browser: photos, pictures, numbers on the top view, and the report."""

from __future__ import annotations

import io
import os
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from playwright.sync_api import Browser, Page, sync_playwright

from bench.chromium import ARGUMENTS, chromium
from tests.support.browser_scene import SCREENSHOTS_VARIABLE
from tests.support.dicom_scene import ORDER, Built
from tests.support.ohif import ohif
from tests.support.orthanc import RunningOrthanc

WINDOW = {"width": 1280, "height": 860}
OVERLAY = '[data-cy="viewport-overlay-top-left"]'
LOAD_MS = 90_000
"""The viewer is 60 MB of scripts, and draws without a graphics card."""


@pytest.fixture(scope="module")
def viewer(archive: RunningOrthanc, first_set: Built) -> Iterator[str]:
    """A viewer on an archive that holds the first set."""
    for made in first_set.objects:
        answer = httpx.post(
            f"{archive.url}/instances", content=made.path.read_bytes(), auth=archive.auth, timeout=60, trust_env=False
        )
        answer.raise_for_status()
    with ohif(archive) as url:
        yield url


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    path = chromium()
    if path is None:
        pytest.skip("there is no Chromium: apt-get install chromium, or name one in BROWSER_CHROMIUM")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        yield started
        started.close()


@pytest.fixture
def study(browser: Browser, viewer: str) -> Iterator[Page]:
    """The viewer on the study, with its first photo open."""
    page = browser.new_page(viewport=WINDOW)  # type: ignore[arg-type]
    page.set_default_timeout(LOAD_MS)
    page.goto(f"{viewer}/viewer?StudyInstanceUIDs={ORDER.study_instance_uid}")
    page.get_by_text("Skip all").click()
    page.get_by_text("S:7", exact=True).wait_for()
    page.locator(OVERLAY, has_text="Photos of the specimen").wait_for()
    yield page
    page.close()


def drawn(page: Page, name: str, least_colours: int = 500) -> NDArray[np.uint8]:
    """The viewport (H, W, 3) once it is not blank; kept in the folder of ``BROWSER_SCREENSHOTS`` if that is set."""
    found = np.zeros((1, 1, 3), np.uint8)
    for _ in range(120):
        data = page.locator('[data-cy="viewport-pane"]').first.screenshot()
        found = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
        if len(np.unique(found.reshape(-1, 3), axis=0)) > least_colours:
            break
        page.wait_for_timeout(500)
    else:
        pytest.fail(f"{name} stays blank")
    folder = os.environ.get(SCREENSHOTS_VARIABLE)
    if folder:
        page.screenshot(path=Path(folder, f"{name}.png"))
    return found


def open_series(page: Page, number: int) -> None:
    page.get_by_text(f"S:{number}", exact=True).first.dblclick()


@pytest.mark.slow
def test_a_photo_is_shown_as_it_is(study: Page, first_set: Built) -> None:
    shown = drawn(study, "dicom-photo")
    photo = first_set.one("photo").pixel_array
    # The photo's own colours fill the middle of the viewport.
    height, width = shown.shape[:2]
    middle = shown[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3].reshape(-1, 3).mean(0)
    centre = photo[photo.shape[0] // 4 : 3 * photo.shape[0] // 4, photo.shape[1] // 4 : 3 * photo.shape[1] // 4]
    assert np.abs(middle - centre.reshape(-1, 3).mean(0)).max() < 60
    assert shown.std() > 20


@pytest.mark.slow
def test_pictures_are_shown(study: Page) -> None:
    for number, name in ((2, "Top view with markers"), (3, "Spectral preview")):
        open_series(study, number)
        study.locator(OVERLAY, has_text=name).wait_for()
        assert drawn(study, f"dicom-series-{number}").std() > 20
    # No letters of a patient's axes on an excised specimen.
    assert [
        mark.strip() for mark in study.locator('[class*="rientation-marker"]').all_text_contents() if mark.strip()
    ] == []


@pytest.mark.slow
def test_the_numbers_are_shown_on_the_top_view(study: Page) -> None:
    open_series(study, 5)
    study.get_by_role("button", name="No", exact=True).click()
    words = study.locator("svg.svg-layer tspan")
    for step in range(60):
        # The viewer loads the report beside the image, and draws it with the next change of the viewport.
        study.set_viewport_size({"width": WINDOW["width"] + 20 * (step % 2), "height": WINDOW["height"]})
        study.wait_for_timeout(1000)
        if words.count():
            break
    said = [line.rsplit(": ", 1) for line in words.all_text_contents()]
    names = Counter(name for name, _ in said)
    assert names["Corner in the cube, residual"] == 16
    assert names["Error at this marker when it is left out"] == 4
    assert {"2D corner error, mean", "3D corner error, median", "Leaving a marker out, error, median"} <= set(names)
    # A number and its unit; the viewer shows nothing for a zero, which the residual of a corner may be.
    values = [value.split() for _, value in said]
    assert {value[-1] for value in values} == {"um"}
    known = [float(value[0]) for value in values if len(value) == 2]
    assert len(known) >= 20
    assert all(number > 0 for number in known)
    shown = drawn(study, "dicom-measurements").astype(int)
    yellow = (shown[..., 0] > 200) & (shown[..., 1] > 200) & (shown[..., 2] < 80)
    assert yellow.sum() > 200


@pytest.mark.slow
def test_the_report_opens(study: Page) -> None:
    open_series(study, 6)
    frame = study.locator("object, iframe, embed").first
    frame.wait_for()
    assert drawn(study, "dicom-report", 20).mean() > 60
