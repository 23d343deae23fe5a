"""Keeps worker processes running: one for each slot, started again when one dies."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence

from specimap_infra.logs import logger

FIRST_PAUSE = 0.5
LONGEST_PAUSE = 30.0
GRACE_SECONDS = 10.0
CANNOT_START = 2
"""Exit status of a worker that was refused: starting it again would change nothing."""


class Supervisor:
    """Worker processes as children, watched by a thread each."""

    def __init__(self, slots: int, options: Sequence[str] = ()) -> None:
        self._options = tuple(options)
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._children: dict[int, subprocess.Popen[bytes]] = {}
        self._threads = [threading.Thread(target=self._keep, args=(slot,), daemon=True) for slot in range(slots)]
        self.refused = threading.Event()
        """Set when a worker could not start for a reason that will not go away."""

    def start(self) -> None:
        """Start all."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ask all to end, and end those that do not within ten seconds. Their jobs go on elsewhere, or later."""
        self._stopping.set()
        with self._lock:
            children = list(self._children.values())
        for child in children:
            child.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        for child in children:
            try:
                child.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
        for thread in self._threads:
            thread.join(timeout=2)

    def wait(self) -> None:
        """Until all have ended for good."""
        for thread in self._threads:
            while thread.is_alive():
                thread.join(timeout=0.5)

    def _keep(self, slot: int) -> None:
        command = [sys.executable, "-m", "specimap_workers", "--slot", str(slot), *self._options]
        command += ["--parent", str(os.getpid())]
        pause = FIRST_PAUSE
        while not self._stopping.is_set():
            started = time.monotonic()
            with self._lock:
                if self._stopping.is_set():
                    return
                # In a session of its own: Ctrl-C reaches the parent alone, which then ends the children in order.
                child = self._children[slot] = subprocess.Popen(command, start_new_session=True)
            status = child.wait()
            if self._stopping.is_set():
                return
            if status == CANNOT_START:
                self.refused.set()
                return
            pause = FIRST_PAUSE if time.monotonic() - started > LONGEST_PAUSE else min(pause * 2, LONGEST_PAUSE)
            logger().error("worker died; it is started again", slot=slot, status=status, pause_seconds=pause)
            self._stopping.wait(pause)
