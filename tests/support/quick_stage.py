"""A stage process without the science: leaves what the next stage looks for, and at the end a finished result.

It stands in where a test is about queues and not about stages. ``RESULT_FOLDER``: the result; ``STAGE_SECONDS``: how
long each stage takes.
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

ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)
spec = json.loads(sys.stdin.readline() or "{}")
if spec:
    stage, out = spec["stage"], Path(spec["out"])
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
