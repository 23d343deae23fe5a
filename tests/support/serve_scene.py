"""``specimap serve`` and other programs that run until they are ended, as processes of their own."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from tests.support.worker_scene import until

PROGRAM = (sys.executable, "-c", "from specimap_cli import main; main()")


@dataclass
class Served:
    """A program that serves, and what it has printed."""

    process: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)

    def printed(self, start: str, seconds: float = 40) -> str:
        """The rest of the line that starts so, once it is there."""

        def found() -> str:
            assert self.process.poll() is None, self.lines
            return next((line.removeprefix(start).strip() for line in self.lines if line.startswith(start)), "")

        return str(until(found, seconds, start))


@contextmanager
def running(folder: Path, *arguments: str, **settings: str) -> Iterator[Served]:
    """Run a program, ``serve`` by default, on a folder until the block ends; ``settings`` are variables."""
    environment = {
        **os.environ,
        "SPECIMAP_DATA_DIR": str(folder),
        "SPECIMAP_PORT": "0",
        "SPECIMAP_LOG_LEVEL": "warning",
        "SPECIMAP_LEASE_SECONDS": "4",
        "SPECIMAP_HEARTBEAT_SECONDS": "1",
        "SPECIMAP_MIN_FREE_BYTES": "0",
        "PYTHONUNBUFFERED": "1",
        **settings,
    }
    process = subprocess.Popen(
        [*PROGRAM, *(arguments or ("serve",))],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    served = Served(process)
    assert process.stdout is not None
    reader = threading.Thread(target=lambda out=process.stdout: served.lines.extend(iter(out.readline, "")))
    reader.start()
    try:
        yield served
    finally:
        process.kill()
        process.wait(10)
        reader.join(10)
        process.stdout.close()
