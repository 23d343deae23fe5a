"""Wall, CPU and memory of a child process, stage by stage.

Memory is read from outside, so that measuring costs the child nothing and no peak hides behind its interpreter
lock: anonymous and shared pages of ``/proc/<pid>/status``, which leaves out mapped files (the cube, libraries).
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

SAMPLE_SECONDS = 0.005
ROOT = Path(__file__).resolve().parent.parent


@dataclass
class Cost:
    """What a stage took: seconds, seconds of all threads, MB beyond mapped files at the peak."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0

    def as_dict(self) -> dict[str, float]:
        """Rounded for a record."""
        return {"wall_s": round(self.wall_s, 3), "cpu_s": round(self.cpu_s, 3), "peak_mb": round(self.peak_mb, 1)}


@dataclass
class Measured:
    """``stages`` in order; ``whole`` from the start of the process to its end; ``result``: what the child said."""

    stages: dict[str, Cost] = field(default_factory=dict)
    whole: Cost = field(default_factory=Cost)
    result: dict[str, Any] = field(default_factory=dict)

    def as_dict(self) -> dict[str, object]:
        """For a record."""
        return {
            "stages": {name: cost.as_dict() for name, cost in self.stages.items()},
            "whole": self.whole.as_dict(),
            "result": self.result,
        }


def measure(arguments: Sequence[str]) -> Measured:
    """Run ``python -m bench.child`` with ``arguments``. Raises RuntimeError with its message if it fails."""
    start = time.perf_counter()
    child = subprocess.Popen(
        [sys.executable, "-m", "bench.child", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
    )
    measured, stage, errors = Measured(), ["start"], [""]

    def listen() -> None:
        assert child.stdout is not None
        before = (start, 0.0)
        for line in child.stdout:
            event, now = json.loads(line), time.perf_counter()
            if "result" in event:
                measured.result = event["result"]
            cost = measured.stages.setdefault(stage[0], Cost())
            cost.wall_s += now - before[0]
            cost.cpu_s += event["cpu"] - before[1]
            before, stage[0] = (now, event["cpu"]), event["stage"]

    def drain() -> None:
        assert child.stderr is not None
        errors[0] = child.stderr.read()

    readers = [threading.Thread(target=listen), threading.Thread(target=drain)]
    for reader in readers:
        reader.start()
    peaks: dict[str, float] = {}
    while child.poll() is None:
        peaks[stage[0]] = max(peaks.get(stage[0], 0.0), _memory_mb(child.pid))
        time.sleep(SAMPLE_SECONDS)
    for reader in readers:
        reader.join()
    if child.returncode:
        raise RuntimeError(f"bench.child {' '.join(arguments)} failed:\n{errors[0]}")
    for name, cost in measured.stages.items():
        cost.peak_mb = peaks.get(name, 0.0)
    measured.whole = Cost(
        time.perf_counter() - start, sum(c.cpu_s for c in measured.stages.values()), max(peaks.values(), default=0.0)
    )
    return measured


def _memory_mb(pid: int) -> float:
    try:
        text = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    except OSError:
        return 0.0
    parts = [line.split() for line in text.splitlines() if line.startswith(("RssAnon:", "RssShmem:"))]
    return sum(int(p[1]) for p in parts) / 1024
