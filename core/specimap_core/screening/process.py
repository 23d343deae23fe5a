"""The process that reads files from outside: one JSON line in, one out, until standard input ends.

``python -m specimap_core.screening MEMORY_BYTES FILE_BYTES [SANDBOX [PRIVATE…]]``: how much memory the judging of a
file may take over what the process takes at rest, how large a temporary file may become, the setting of that name, and
places that are never to be read. Each file is judged in a copy of the process (a fork) of its own, which can read that
file's folder and write the task's ``scratch``, and ends with its answer: a file that takes a decoder over, makes it
crash or use up memory costs that copy, and neither the service nor the next file. The process that started this one
stops it when it takes too long.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image

from specimap_core.fiducials.detection import detect_markers
from specimap_core.json_text import json_text
from specimap_core.photos.decoding import set_up_pillow
from specimap_core.sandbox import MODES, Confinement, Mode, Reach, program_rules
from specimap_core.sandbox.landlock import READ, WRITE
from specimap_core.sandbox.lifetime import die_with
from specimap_core.sandbox.places import Rule
from specimap_core.screening.cube import judge_cube, judge_part
from specimap_core.screening.photo import Others, judge_photo
from specimap_core.screening.verdict import Verdict
from specimap_core.threads import step_back

LARGEST_ANSWER = 256 * 1024
MOST_OPEN = 128
DIED: dict[str, Any] = {"died": True}
"""The answer where a file's process ended without one."""


def _photo(task: dict[str, Any]) -> Verdict:
    others = Others(task["sharpness"], [(w, h) for w, h in task["sizes"]])
    return judge_photo(Path(task["path"]), task["dictionary"], others, task["most_pixels"])


def _part(task: dict[str, Any]) -> Verdict:
    return judge_part(Path(task["path"]), task["claimed"], task["expected_bytes"])


def _cube(task: dict[str, Any]) -> Verdict:
    return judge_cube(Path(task["path"]))


TASKS: dict[str, Callable[[dict[str, Any]], Verdict]] = {"photo": _photo, "part": _part, "cube": _cube}


def _address_space() -> int:
    pages = Path("/proc/self/statm")
    return int(pages.read_text().split()[0]) * resource.getpagesize() if pages.exists() else 1 << 30


class Copy:
    """A copy of this process, for one file. It is made ahead, since copying takes as long as a small photo."""

    def __init__(self, memory: int, rules: list[Rule], mode: Mode) -> None:
        task, self._task = os.pipe()
        self._answer, answer = os.pipe()
        parent = os.getpid()
        self.pid = os.fork()
        if self.pid == 0:
            try:
                die_with(parent)
                _judge_one(task, answer, memory, rules, mode)
            except BaseException:
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        os.close(task)
        os.close(answer)

    def judge(self, line: str) -> bytes:
        """Its answer to a task, one line each; :meth:`end` follows.

        Raises:
            BrokenPipeError: it had ended before it saw the task.
        """
        with open(self._task, "wb", buffering=0) as pipe:
            pipe.write(line.encode())
        received = b""
        with open(self._answer, "rb", buffering=0) as pipe:
            while b"\n" not in received and len(received) <= LARGEST_ANSWER and (piece := pipe.read(1 << 16)):
                received += piece
        # One line and no more: the rest would be taken for the next file's answer.
        answer, end, _ = received.partition(b"\n")
        return answer + end if end else json_text(DIED).encode() + b"\n"

    def end(self) -> None:
        """End it. That takes as long as making it: the answer is sent before."""
        with suppress(ProcessLookupError):
            os.kill(self.pid, signal.SIGKILL)
        os.waitpid(self.pid, 0)


def _judge_one(reading: int, writing: int, memory: int, rules: list[Rule], mode: Mode) -> None:
    # The pipes to the service are not for this copy: it could read the next tasks, and answer them.
    nothing = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(nothing, descriptor)
    for descriptor in _open_descriptors() - {0, 1, 2, reading, writing}:
        os.close(descriptor)
    confinement, at_rest = Confinement(rules, mode), _address_space()
    with open(reading, encoding="utf-8") as pipe:
        line = pipe.readline()
    if not line:
        return
    task = json.loads(line)
    folder, scratch = Path(task["path"]).parent, task["scratch"]
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    # Cubes are mapped, which takes addresses and no memory.
    mapped = sum(f.stat().st_size for f in folder.iterdir()) if task["kind"] == "cube" else 0
    for limit, most in ((resource.RLIMIT_AS, at_rest + memory + mapped), (resource.RLIMIT_NOFILE, MOST_OPEN)):
        resource.setrlimit(limit, (most, most))
    confinement.enter([(str(folder), READ), (scratch, WRITE)], alone=True)
    answer = json_text(TASKS[task["kind"]](task).as_dict()).encode() + b"\n"
    while answer:
        answer = answer[os.write(writing, answer) :]


def _open_descriptors() -> set[int]:
    there = set()
    for descriptor in range(256):
        try:
            os.fstat(descriptor)
        except OSError:
            continue
        there.add(descriptor)
    return there


def main() -> None:
    """Judge files until there are no more."""
    memory, largest_file = int(sys.argv[1]), int(sys.argv[2])
    mode: Mode = sys.argv[3] if len(sys.argv) > 3 and sys.argv[3] in MODES else "best-effort"  # type: ignore[assignment]
    die_with(os.getppid())
    step_back()
    # Libraries that print must not get between the lines.
    out = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (largest_file, largest_file))
    cv2.setNumThreads(1)
    detect_markers(np.zeros((64, 64), np.uint8), "DICT_4X4_50", expected=0)  # fills OpenCV's tables
    set_up_pillow()
    Image.init()
    rules = program_rules(Reach(keep_from=[Path(place) for place in sys.argv[4:]]))
    copy = Copy(memory, rules, mode)
    out.write(json_text({"ready": True}).encode() + b"\n")
    for line in sys.stdin:
        try:
            answer = copy.judge(line)
        except BrokenPipeError:  # the system killed it while it waited, for its memory perhaps: no fault of the file
            copy.end()
            copy = Copy(memory, rules, mode)
            answer = copy.judge(line)
        out.write(answer)
        copy.end()
        copy = Copy(memory, rules, mode)
