"""A stage's process for tests: the real one, or with ``quick`` one that leaves what the next stage looks for.

While a file of a stage's name lies in ``HOLD_FOLDER``, the stage waits at its beginning. ``KILL_WORKER`` names a stage
at whose beginning the worker is killed instead, ``KILL_SELF`` one where it kills itself. The quick one stands in where
a test is about queues and not about stages: ``RESULT_FOLDER`` is the finished result that it gives, ``STAGE_SECONDS``
how long each stage takes.
"""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import Any, TextIO


def hold(stage: str) -> None:
    """What befalls a stage before it begins."""
    if os.environ.get("KILL_WORKER") == stage:
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)
    if os.environ.get("KILL_SELF") == stage:
        os.kill(os.getpid(), signal.SIGSEGV)
    folder = Path(os.environ["HOLD_FOLDER"])
    if (folder / stage).exists():
        (folder / f"{stage}.pid").write_text(str(os.getpid()), "ascii")
        while (folder / stage).exists():
            time.sleep(0.02)


def run_real() -> None:
    """The program that workers start, with its stages held."""
    from specimap_workers import stage_main

    real = stage_main._run

    def held(spec: dict[str, Any], out: TextIO) -> None:
        hold(spec["stage"])
        real(spec, out)

    stage_main._run = held
    # Most of these processes are killed, or wait for a stage that never comes: a stage that runs imports what it needs.
    stage_main._load = lambda: None
    stage_main.main()


def run_quick() -> None:
    """The same without the science, and without the libraries."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
    spec = json.loads(sys.stdin.readline() or "{}")
    if not spec:
        return
    stage, out = spec["stage"], Path(spec["out"])
    hold(stage)
    print(json.dumps({"event": "progress", "stage": stage, "share": 0.0}), flush=True)
    time.sleep(float(os.environ.get("STAGE_SECONDS", "0")))
    if stage == "register":
        for path in Path(os.environ["RESULT_FOLDER"]).iterdir():
            if path.name == "stages" or path.name.startswith("."):
                continue
            if path.is_dir():
                # One that was killed may have left a part of it.
                shutil.copytree(path, out / path.name, dirs_exist_ok=True)
            else:
                shutil.copyfile(path, out / path.name)
    else:
        (out / "stages").mkdir(exist_ok=True)
        (out / "stages" / f"{stage}-{spec['keys'][stage]}.npz").write_bytes(b"an artefact")
    print(json.dumps({"event": "done", "seconds": 0.01}), flush=True)


if "quick" in sys.argv:
    run_quick()
else:
    run_real()
os._exit(0)
