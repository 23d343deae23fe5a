"""The real stage process, which waits at the beginning of a stage while a file of the stage's name is there.

``KILL_WORKER`` names a stage at whose beginning the worker is killed instead, ``KILL_SELF`` one where it kills itself.
"""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any, TextIO

from specimap_workers import stage_main

FOLDER = Path(os.environ["HOLD_FOLDER"])
real = stage_main._run


def held(spec: dict[str, Any], out: TextIO) -> None:
    stage = spec["stage"]
    if os.environ.get("KILL_WORKER") == stage:
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)
    if os.environ.get("KILL_SELF") == stage:
        os.kill(os.getpid(), signal.SIGSEGV)
    if (FOLDER / stage).exists():
        (FOLDER / f"{stage}.pid").write_text(str(os.getpid()), "ascii")
        while (FOLDER / stage).exists():
            time.sleep(0.02)
    real(spec, out)


stage_main._run = held
# Most of these processes are killed, or wait for a stage that never comes: a stage that runs imports what it needs.
stage_main._load = lambda: None
stage_main.main()
os._exit(0)
