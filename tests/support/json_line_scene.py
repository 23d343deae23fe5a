"""Child processes that exchange JSON lines, for the tests of what they do."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from specimap_core.sandbox.json_lines import (
    JsonLineProcess,
)

PATIENCE_SECONDS = 20.0
"""For what takes milliseconds, on a crowded machine."""


START = "import json, os, signal, subprocess, sys, time\n"
SLEEPER = "subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'], stdin=subprocess.DEVNULL)"


def start(program: str, log: Path | None = None, takes_messages: bool = True) -> JsonLineProcess:
    command = [sys.executable, "-S", "-c", START + program]
    return JsonLineProcess(command, env=dict(os.environ), log=log, takes_messages=takes_messages)


def is_gone(pid: int) -> bool:
    """Whether a process has ended; a zombie that nobody collects counts as ended."""
    deadline = time.monotonic() + PATIENCE_SECONDS
    while time.monotonic() < deadline:
        try:
            if Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z":
                return True
        except OSError:
            return True
        time.sleep(0.01)
    return False


def open_descriptors() -> set[str]:
    found = set()
    for name in os.listdir("/proc/self/fd"):
        try:
            found.add(f"{name} {os.readlink(f'/proc/self/fd/{name}')}")
        except OSError:  # that of the listing itself
            continue
    return found


@pytest.fixture
def descriptors() -> Iterator[None]:
    """Asserts that the test leaves no descriptor open."""
    before = open_descriptors()
    yield
    assert open_descriptors() == before
