"""Keeps worker processes running: one for each slot, started again for ever when one ends."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence

from specimap_infra.logs import logger
from specimap_workers.executors import new_executor

FIRST_PAUSE = 0.2
LONGEST_PAUSE = 5.0
"""So long, and a start, a job may wait for the one worker there is."""
STEADY_SECONDS = 15.0
"""A worker that has lived so long is started again at once."""
GRACE_SECONDS = 10.0


def _nobody(executor: str, died: bool) -> None:
    """Leave it to the next worker."""


class Supervisor:
    """Worker processes as children, watched by a thread each.

    None of their ends is final: what kept one from working (a database, a storage or a disk that is away or full, a
    file of settings under repair) may pass, and a service without a worker looks sound while no job gets on.
    """

    def __init__(
        self,
        slots: int,
        options: Sequence[str] = (),
        bury: Callable[[str, bool], None] = _nobody,
        module: str = "specimap_workers",
    ) -> None:
        """``module``: what a child runs. ``bury`` is called with the name of each worker that has ended, and whether
        that was a death.

        It hands over what the worker held at once; where it fails, leases and notes do so later.
        """
        self._options = tuple(options)
        self._bury = bury
        self._module = module
        self._stopping = threading.Event()
        self._lock = threading.Lock()
        self._children: dict[int, tuple[str, subprocess.Popen[bytes]]] = {}
        self._threads = [threading.Thread(target=self._keep, args=(slot,), daemon=True) for slot in range(slots)]

    def start(self) -> None:
        """Start all."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ask all to end, and end those that do not within ten seconds. Their jobs go on elsewhere, or later."""
        self._stopping.set()
        with self._lock:
            children = list(self._children.values())
        for _, child in children:
            child.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        for executor, child in children:
            try:
                child.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()
                self._hand_over(executor, died=False)
        for thread in self._threads:
            thread.join(timeout=2)

    def wait(self) -> None:
        """Until all have ended for good: after :meth:`stop`."""
        for thread in self._threads:
            while thread.is_alive():
                thread.join(timeout=0.5)

    def _keep(self, slot: int) -> None:
        pause = FIRST_PAUSE
        while not self._stopping.is_set():
            started, executor = time.monotonic(), new_executor(slot)
            command = [sys.executable, "-m", self._module, "--slot", str(slot), *self._options]
            command += ["--parent", str(os.getpid()), "--executor", executor]
            with self._lock:
                if self._stopping.is_set():
                    return
                # In a session of its own: Ctrl-C reaches the parent alone, which then ends the children in order.
                child = subprocess.Popen(command, start_new_session=True)  # noqa: S603 - this program itself
                self._children[slot] = executor, child
            status = child.wait()
            if self._stopping.is_set():
                return
            if time.monotonic() - started > STEADY_SECONDS:
                pause = FIRST_PAUSE
            logger().error("worker ended; it is started again", slot=slot, status=status, pause_seconds=pause)
            self._hand_over(executor, died=True)
            self._stopping.wait(pause)
            pause = min(pause * 2, LONGEST_PAUSE)

    def _hand_over(self, executor: str, *, died: bool) -> None:
        try:
            self._bury(executor, died)
        except Exception as error:
            # The next worker finds it too; this thread must outlive any error.
            logger().warning("work not handed over yet", executor=executor, error=type(error).__name__)
