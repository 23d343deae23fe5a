"""The processes that are killed: the API, machines with workers, and hogs, which only take processor time."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from bench.service.serving import COMMAND


class Api:
    """The API's process on one port, killed and started again."""

    def __init__(self, port: int) -> None:
        self._environment = {**os.environ, "SPECIMAP_PORT": str(port)}
        self._process = self._start()

    def kill(self) -> None:
        """Kill it, and start it again."""
        self.end()
        self._process = self._start()

    def end(self) -> None:
        """Kill it."""
        self._process.kill()
        self._process.wait()

    def _start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([*COMMAND, "--no-worker"], env=self._environment, stdout=subprocess.DEVNULL)


class Machine:
    """A supervisor with its workers, and local folders that no other machine sees."""

    def __init__(self, scratch: Path, slots: int, stage_command: str) -> None:
        self._scratch, self._slots, self._stage_command = scratch, slots, stage_command
        self._lives = 0
        self._process = self._start()

    def kill(self) -> None:
        """Kill all of it at once, and start one with empty folders in its place: the dead one does not come back."""
        # Its workers, and theirs, die with it: each asks the kernel for that.
        self._process.kill()
        self._process.wait()
        self._process = self._start()

    def end(self) -> None:
        """Stop it in order."""
        self._process.terminate()
        self._process.wait(60)

    def workers(self) -> list[int]:
        """Process ids of its workers."""
        return children(self._process.pid, "specimap_workers")

    def _start(self) -> subprocess.Popen[bytes]:
        self._lives += 1
        environment = {**os.environ, "SPECIMAP_SCRATCH_DIR": f"{self._scratch}-{self._lives}"}
        command = [sys.executable, "-m", "bench.faults.machine", str(self._slots), self._stage_command]
        return subprocess.Popen(command, env=environment)


@contextmanager
def hogs(count: int) -> Iterator[None]:
    """Let so many processes take all the processor time that they get."""
    started = [subprocess.Popen([sys.executable, "-I", "-S", "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def children(parent: int, word: str) -> list[int]:
    """Processes whose parent is that one and whose command holds the word."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError):
            above = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if above == parent and word in (entry / "cmdline").read_text():
                found.append(int(entry.name))
    return found


def executor_of(pid: int) -> str | None:
    """The name that a worker was started with."""
    with suppress(OSError, ValueError):
        words = (Path("/proc") / str(pid) / "cmdline").read_text().split("\0")
        return words[words.index("--executor") + 1]
    return None


def kill(pid: int) -> bool:
    """Kill a process; whether it was there."""
    with suppress(ProcessLookupError):
        os.kill(pid, signal.SIGKILL)
        return True
    return False
