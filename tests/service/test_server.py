"""The server's process: what lives as long as it does costs no later request anything."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import gc, json, sys
from pathlib import Path
from specimap_infra.settings import load_settings
from specimap_service.app import create_app
from specimap_service.server import keep_collections_short
app = create_app(load_settings(data_dir=Path(sys.argv[1])))
before = len(gc.get_objects())
keep_collections_short()
print(json.dumps([before, len(gc.get_objects())]))
"""


@pytest.mark.slow
def test_collections_leave_out_what_lives_as_long_as_the_process(tmp_path: Path) -> None:
    # In a process of its own: what is left out stays so for good.
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)], capture_output=True, text=True, check=True, timeout=120
    )
    before, after = json.loads(done.stdout)
    assert before > 100_000
    assert after < before / 100
