"""The process that looks into files from outside: one JSON line in, one out, until standard input ends.

``python -m specimap.core.intake MEMORY_BYTES FILE_BYTES``: how much memory the judging of a file may take over what
the process takes at rest, and how large a temporary file may become. A file that makes a decoder crash, hang or
swallow memory costs this process, not the service; whoever started it stops it when it takes too long.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from specimap.core.fiducials import detect_markers
from specimap.core.intake.cube import judge_cube, judge_part
from specimap.core.intake.photo import Others, judge_photo
from specimap.core.intake.verdict import Verdict
from specimap.core.jsontext import json_text

PR_SET_PDEATHSIG = 1


def _photo(task: dict[str, Any]) -> Verdict:
    others = Others(task["sharpness"], [(w, h) for w, h in task["sizes"]])
    return judge_photo(Path(task["path"]), task["dictionary"], others)


def _part(task: dict[str, Any]) -> Verdict:
    return judge_part(Path(task["path"]), task["claimed"], task["expected_bytes"])


def _cube(task: dict[str, Any]) -> Verdict:
    return judge_cube(Path(task["path"]))


TASKS: dict[str, Callable[[dict[str, Any]], Verdict]] = {"photo": _photo, "part": _part, "cube": _cube}


def _address_space() -> int:
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 1 << 30


def _limit_memory(most: int) -> None:
    resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))


def main() -> None:
    """Judge files until there are no more."""
    memory, largest_file = int(sys.argv[1]), int(sys.argv[2])
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    # Libraries that print must not get between the lines.
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
    cv2.setNumThreads(1)
    detect_markers(np.zeros((64, 64), np.uint8), "DICT_4X4_50", expected=0)  # fills OpenCV's tables
    at_rest = _address_space()
    print(json_text({"ready": True}), file=out, flush=True)
    for line in sys.stdin:
        task = json.loads(line)
        # Cubes are mapped, which takes addresses and no memory.
        mapped = sum(f.stat().st_size for f in Path(task["path"]).parent.iterdir()) if task["kind"] == "cube" else 0
        _limit_memory(at_rest + memory + mapped)
        verdict = TASKS[task["kind"]](task)
        print(json_text(verdict.as_dict()), file=out, flush=True)


if __name__ == "__main__":
    main()
    # Native libraries' threads may hang in the interpreter's end.
    os._exit(0)
