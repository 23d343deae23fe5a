"""Scripts for a child process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from specimap_core.arrays import Array
from specimap_core.sandbox.process import Answer, run_child

STEPS = {"first": 1.0, "second": 3.0}


def ask(
    folder: Path,
    body: str,
    arrays: dict[str, Array] | None = None,
    progress: Callable[[float], None] = lambda share: None,
    **options: object,
) -> Answer:
    """Run a script whose ``run`` has that body."""
    script = folder / "script.py"
    lines = "\n".join("    " + line for line in body.splitlines())
    script.write_text(
        f"import json, os, subprocess, sys, time\nimport numpy as np\n\ndef run(request, arrays, step):\n{lines}\n",
        "utf-8",
    )
    scratch = folder / "scratch"
    try:
        return run_child(
            script,
            {"factor": 3, "place": folder},
            arrays or {},
            name="mast3r",
            steps=STEPS,
            progress=progress,
            scratch=scratch,
            **options,  # type: ignore[arg-type]
        )
    finally:
        assert list(scratch.iterdir()) == []


LONG = """
helper = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])
open(os.path.join(request['place'], 'pids'), 'w').write(f'{os.getpid()} {helper.pid} ')
step('first', 1)
time.sleep(600)
return {}, {}
"""
