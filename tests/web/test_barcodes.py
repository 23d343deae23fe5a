"""Barcodes on labels, held into a camera: Chromium on Linux has no detector of its own, as Safari has none."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import Browser, expect
from reportlab.graphics.barcode.code128 import Code128

from tests.support.browser_scene import TABLET, Window, launch
from tests.support.service_scene import Running

Picture = NDArray[np.uint8]
WIDTH, HEIGHT = 1280, 720


def code_128(text: str) -> Picture:
    """The bars of a label: white and black modules, with a quiet zone."""
    code = Code128(text)
    code.validate()
    code.encode()
    code.decompose()
    # Letters are widths in modules, capitals bars.
    modules = [0] * 10
    for letter in code.decomposed:
        modules += [int(letter.isupper())] * (ord(letter.lower()) - ord("a") + 1)
    row = 255 * (1 - np.array(modules + [0] * 10, np.uint8))
    return np.repeat(np.repeat(row[None], 60, 0), 4, 1)


def qr(text: str) -> Picture:
    code = np.asarray(cv2.QRCodeEncoder.create().encode(text), np.uint8)
    return np.pad(np.kron(code, np.ones((8, 8), np.uint8)), 32, constant_values=255)


def write_camera(path: Path, label: Picture) -> None:
    """A label on a grey table, slightly turned, noisy and blurred, as a camera shows it."""
    rng = np.random.default_rng(5)
    table = np.full((HEIGHT, WIDTH), 140, np.uint8)
    top, left = (HEIGHT - label.shape[0]) // 2, (WIDTH - label.shape[1]) // 2
    table[top : top + label.shape[0], left : left + label.shape[1]] = label
    frames = []
    for _ in range(10):
        turn = cv2.getRotationMatrix2D((WIDTH / 2, HEIGHT / 2), float(rng.uniform(-3, 3)), 1.0)
        frame = cv2.GaussianBlur(cv2.warpAffine(table, turn, (WIDTH, HEIGHT), borderValue=140), (3, 3), 0.8)
        noisy = np.clip(frame + rng.normal(0, 6, frame.shape), 0, 255).astype(np.uint8)
        frames.append(cv2.imencode(".jpg", cv2.cvtColor(noisy, cv2.COLOR_GRAY2BGR))[1].tobytes())
    path.write_bytes(b"".join(frame * 5 for frame in frames))


@pytest.mark.parametrize("made", [code_128, qr])
def test_a_label_in_the_camera_gives_the_specimens_id(
    service: Running, browser: Browser, tmp_path: Path, made: Callable[[str], Picture]
) -> None:
    write_camera(tmp_path / "camera.mjpeg", made("SP-2026-0117"))
    own = launch(browser.browser_type, tmp_path / "camera.mjpeg")
    try:
        context = own.new_context(viewport=TABLET, locale="en-GB")  # type: ignore[arg-type]
        window = Window(context.new_page())
        page = window.page
        page.on("console", lambda said: window.errors.append(said.text) if "Content Security" in said.text else None)
        assert page.evaluate("() => 'BarcodeDetector' in globalThis") is False
        window.sign_in(service.url, service.key())
        page.goto(f"{service.url}/#/capture")
        page.get_by_test_id("scan-barcode").click()
        expect(page.get_by_test_id("new-specimen-id")).to_have_value("SP-2026-0117", timeout=60_000)
        assert window.errors == []
    finally:
        own.close()


def test_a_code_that_is_no_id_is_said_and_not_taken(service: Running, browser: Browser, tmp_path: Path) -> None:
    write_camera(tmp_path / "camera.mjpeg", qr("https://label.example/?p=Doe Jane"))
    own = launch(browser.browser_type, tmp_path / "camera.mjpeg")
    try:
        page = own.new_context(viewport=TABLET, locale="en-GB").new_page()  # type: ignore[arg-type]
        Window(page).sign_in(service.url, service.key())
        page.goto(f"{service.url}/#/capture")
        page.get_by_test_id("scan-barcode").click()
        expect(page.get_by_role("alert")).to_contain_text("is no specimen id", timeout=60_000)
        assert page.get_by_test_id("new-specimen-id").input_value() == ""
    finally:
        own.close()
