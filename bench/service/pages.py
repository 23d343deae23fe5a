"""The viewer in a headless Chromium, on a full-size cloud: how long a person waits, and how fluently it turns."""

from __future__ import annotations

import statistics
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

from bench.chromium import ARGUMENTS, chromium
from bench.service.options import Options
from bench.service.scene import Result, put_full_result
from bench.service.serving import Served, serving
from bench.service.sheet import Sheet, reached

TARGETS_MS = {"first_picture": 2000.0, "band": 150.0, "tap": 50.0}
TARGET_FRAMES = 30.0
TURNS_SECONDS = 3
TAPS = 10
NAMES = {
    "first_picture": "first picture, coarse",
    "all_points": "all points read and drawn",
    "band": "another band, first seen",
    "band_exact": "another band, exact values",
    "tap": "spectrum of a tapped point",
}
# When the picture was first drawn, and when all points were there; when what a click or a key asked for was drawn.
WATCH = """
addEventListener('DOMContentLoaded', () => new MutationObserver(() => {
  const canvas = document.querySelector('[data-testid=viewer-canvas]');
  if (canvas?.dataset.drawn) window.firstAt ??= performance.now();
  if (canvas?.dataset.state === 'ready') window.readyAt ??= performance.now();
}).observe(document.body, { subtree: true, childList: true, attributes: true }));
window.until = async (holds) => {
  const start = performance.now();
  while (!holds()) {
    if (performance.now() - start > 60000) throw new Error('nothing happened in a minute');
    await new Promise(requestAnimationFrame);
  }
  return performance.now() - start;
};
"""
BAND = """async (band) => {
  const canvas = document.querySelector('[data-testid=viewer-canvas]');
  const slider = document.querySelector('[data-testid=band-slider]');
  const start = performance.now(), drawn = Number(canvas.dataset.drawn);
  slider.value = String(band);
  slider.dispatchEvent(new Event('input', { bubbles: true }));
  const first = await until(() => Number(canvas.dataset.drawn) > drawn);
  // The panel follows the picture.
  for (let k = 0; k < 3; k++) await new Promise(requestAnimationFrame);
  const exact = () => document.querySelector('[data-testid=exactness]')?.dataset.exact === 'true';
  await until(exact);
  return [first, performance.now() - start];
}"""
EXACT = "() => until(() => document.querySelector('[data-testid=exactness]')?.dataset.exact === 'true')"
TAP = """async ([x, y]) => {
  const canvas = document.querySelector('[data-testid=viewer-canvas]');
  const shown = () => document.querySelector('[data-testid=point-details]')?.textContent ?? '';
  const before = shown();
  for (const type of ['pointerdown', 'pointerup']) {
    const at = { clientX: x, clientY: y, bubbles: true, pointerId: 1, isPrimary: true, button: 0 };
    canvas.dispatchEvent(new PointerEvent(type, at));
  }
  return await until(() => shown() !== before);
}"""
TURN = """async (seconds) => {
  const canvas = document.querySelector('[data-testid=viewer-canvas]');
  const start = performance.now(), drawn = Number(canvas.dataset.drawn);
  while (performance.now() - start < 1000 * seconds) {
    canvas.dispatchEvent(new KeyboardEvent('keydown', { key: 'ArrowLeft', bubbles: true }));
    await new Promise(requestAnimationFrame);
  }
  return (Number(canvas.dataset.drawn) - drawn) / ((performance.now() - start) / 1000);
}"""


def bench_pages(work: Path, options: Options) -> dict[str, Any]:
    """Open the cloud ``repeats`` times in a browser that keeps nothing; WebGL is drawn by the processor.

    Raises:
        FileNotFoundError: there is no Chromium.
    """
    path = chromium()
    if path is None:
        raise FileNotFoundError("There is no Chromium: apt-get install chromium")
    runs: list[dict[str, Any]] = []
    with serving(work / "pages") as served, sync_playwright() as playwright:
        result = put_full_result(served, work)
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        for _ in range(options.repeats):
            context = browser.new_context(viewport={"width": 1180, "height": 820})
            context.set_default_timeout(120_000)
            runs.append(_one(context.new_page(), served, result))
            context.close()
        figures = {
            "points": result.cloud.n_points,
            "bands": result.cloud.bands,
            "browser": f"Chromium {browser.version}",
            "renderer": "SwiftShader, on the processor",
            "runs": runs,
        }
        browser.close()
    return figures


def _one(page: Page, served: Served, result: Result) -> dict[str, Any]:
    page.add_init_script(WATCH)
    page.goto(served.url)
    page.get_by_label("Key", exact=True).fill(served.key)
    page.get_by_role("button", name="Sign in").click()
    page.get_by_role("button", name="Sign out").wait_for()
    # A document of its own, with nothing of the viewer in the memory.
    page.goto("about:blank")
    page.goto(f"{served.url}/#/view/{result.cloud_id}")
    page.evaluate("() => until(() => window.readyAt !== undefined)")
    first, ready = page.evaluate("[window.firstAt, window.readyAt]")
    page.get_by_test_id("colour-mode").select_option("band")
    page.evaluate(EXACT)
    bands = [page.evaluate(BAND, band) for band in (40, 120, 200, 280)]
    taps = []
    for number in range(TAPS + 1):
        index = (number + 1) * result.cloud.n_points // (TAPS + 2)
        at = page.evaluate(f"window.specimapViewer.project({index})")
        taps.append(page.evaluate(TAP, [at["x"], at["y"]]))
    page.get_by_test_id("colour-mode").select_option("photo")
    page.evaluate(TURN, 1)
    return {
        "first_picture": round(first),
        "all_points": round(ready),
        "band": round(statistics.median(one for one, _ in bands), 1),
        "band_exact": round(statistics.median(exact for _, exact in bands), 1),
        # The first one loads the plot.
        "tap": round(statistics.median(taps[1:]), 1),
        "frames_per_s": round(page.evaluate(TURN, TURNS_SECONDS), 1),
    }


def sheet_pages(figures: dict[str, Any]) -> list[Sheet]:
    """Waits in ms, fastest and slowest run, and frames a second."""
    sheet = Sheet(
        f"The viewer on {figures['points']} points x {figures['bands']} bands, {len(figures['runs'])} runs",
        ("what", "fastest ms", "slowest ms", "target ms", "reached"),
    )
    for name, words in NAMES.items():
        values = [run[name] for run in figures["runs"]]
        target = TARGETS_MS.get(name)
        ends = ("-", "-") if target is None else (f"{target:.0f}", reached(min(values), target, least=False))
        sheet.rows.append((words, f"{min(values):.0f}", f"{max(values):.0f}", *ends))
    frames = [run["frames_per_s"] for run in figures["runs"]]
    sheet.notes.append(
        f"{figures['browser']}, headless; WebGL by {figures['renderer']}: turning the cloud, {min(frames):.1f} to "
        f"{max(frames):.1f} frames/s, where an integrated GPU should reach {TARGET_FRAMES:.0f}; no GPU was at hand. "
        "Browser and service share the cores."
    )
    return [sheet]
