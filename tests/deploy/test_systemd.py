"""The unit for systemd that the page for hospitals shows."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.places import DOCS

ANALYZE = shutil.which("systemd-analyze")


@pytest.mark.skipif(ANALYZE is None, reason="systemd is not installed")
def test_the_unit_reads_and_gives_little_away(tmp_path: Path) -> None:
    page = (DOCS / "hospital-it.md").read_text()
    (unit,) = re.findall(r"```ini\n(\[Unit\].*?)```", page, re.DOTALL)
    assert "LimitNOFILE=" in unit
    file = tmp_path / "specimap.service"
    file.write_text(unit.replace("/opt/specimap/.venv/bin/specimap", "/bin/true"))
    for arguments in (["verify", "--man=no"], ["security", "--offline=yes", "--no-pager", "--threshold=35"]):
        done = subprocess.run([str(ANALYZE), *arguments, str(file)], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "Unknown" not in done.stderr
