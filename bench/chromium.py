"""The machine's Chromium, as tests and benchmarks start it."""

from __future__ import annotations

import os
import shutil

VARIABLE = "BROWSER_CHROMIUM"
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


def chromium() -> str | None:
    """Path of the program, or None where there is none."""
    return os.environ.get(VARIABLE) or next(filter(None, map(shutil.which, NAMES)), None)
