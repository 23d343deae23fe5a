"""The units for systemd."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.places import DOCS, ROOT

ANALYZE = shutil.which("systemd-analyze")
UNITS = ROOT / "docker" / "systemd"
NAMES = ("specimap.service", "specimap-worker@.service", "specimap-hospital.service")
MOST_EXPOSED = 20
"""Tenths of the level of exposure that systemd gives, of 100."""


def test_every_unit_is_checked_and_described() -> None:
    assert {file.name for file in UNITS.iterdir()} == set(NAMES)
    page = (DOCS / "hospital-it.md").read_text("utf-8")
    assert all(name in page for name in NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_unit_starts_a_command_that_there_is_as_a_user_of_its_own(name: str) -> None:
    unit = (UNITS / name).read_text("utf-8")
    (command,) = re.findall(r"^ExecStart=/opt/specimap/\.venv/bin/specimap (\w+)", unit, re.MULTILINE)
    assert command == {"specimap": "serve", "specimap-worker@": "worker", "specimap-hospital": "hospital"}[name[:-8]]
    assert "\nUser=specimap\n" in unit
    assert re.search(r"^MemoryMax=\d+G$", unit, re.MULTILINE)
    assert "LimitNOFILE=" in unit


@pytest.mark.skipif(ANALYZE is None, reason="systemd is not installed")
@pytest.mark.parametrize("name", NAMES)
def test_a_unit_reads_and_gives_little_away(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_text((UNITS / name).read_text("utf-8").replace("/opt/specimap/.venv/bin/specimap", "/bin/true"), "utf-8")
    file.with_name("specimap.service").touch()
    verified = str(file).replace("@.", "@1.")
    shutil.copy(file, verified) if verified != str(file) else None
    for arguments, path in (
        (["verify", "--man=no"], verified),
        (["security", "--offline=yes", "--no-pager", f"--threshold={MOST_EXPOSED}"], str(file)),
    ):
        done = subprocess.run([str(ANALYZE), *arguments, path], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Unknown" not in done.stderr
