"""The job engine's threads that take work from the queues, waiting for notifications instead of polling.

The engine (DBOS, pinned exactly) claims with one statement that skips locked rows, but learns of new work by polling
alone: each queue's thread asks four times a second, a thread above them lists the queues every second, and a queue
that is not used here is asked as well: 43 transactions a second of a worker that has nothing to do. Here its loop that
claims stays as it is, and gets another wait: for a notification, for the end of the work that it holds, or for the
poll that makes up for notifications that were lost.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence

import dbos._dbos
import dbos._workflow_commands
from dbos import DBOS
from dbos._queue import Queue, queue_worker_thread

LOOK_SECONDS = 0.1
"""How often a queue that holds work looks whether it has ended; that asks no database."""
DEAF_SECONDS = 1.0
"""Longest wait while no notification can arrive."""
BACKGROUND_SECONDS = 5.0
"""How often the engine looks for workflows with a delay or a deadline, of which there are none here."""


def quieten_engine() -> None:
    """Keep the engine from starting threads of its own that poll; before its launch."""
    # It looks both up in its modules when it starts its threads.
    dbos._dbos.queue_thread = _no_queue_thread  # type: ignore[assignment,attr-defined]
    dbos._workflow_commands._BACKGROUND_JOBS_INTERVAL_SEC = BACKGROUND_SECONDS


def _no_queue_thread(stop: threading.Event, engine: DBOS) -> None:
    """Stand in for the engine's thread that lists queues and starts a thread for each."""


class Wakeable(threading.Event):
    """The event that stops a queue's thread; its wait also ends where there may be work.

    While the queue holds work, which is all that it may, it waits for the end of that.
    """

    def __init__(self, is_busy: Callable[[], bool], hears: Callable[[], bool]) -> None:
        super().__init__()
        self._is_busy = is_busy
        self._hears = hears
        self._woken = threading.Event()
        self._was_busy = False

    def wake(self) -> None:
        """End a wait, or the next one."""
        self._woken.set()

    def set(self) -> None:
        """Stop the thread."""
        super().set()
        self.wake()

    def wait(self, timeout: float | None = None) -> bool:
        """Wait for work; return whether the thread is to stop."""
        start = time.monotonic()
        while not self.is_set():
            if self._is_busy():
                self._was_busy = True
                super().wait(LOOK_SECONDS)
                continue
            longest = timeout if timeout is not None and self._hears() else min(timeout or DEAF_SECONDS, DEAF_SECONDS)
            left = start + longest - time.monotonic()
            if self._was_busy or left <= 0 or self._woken.wait(min(left, DEAF_SECONDS)):
                break
        self._woken.clear()
        # Work that ends after this, and before the next wait, leaves room that nobody has looked for work for.
        self._was_busy = self._is_busy()
        return self.is_set()


class QueueThreads:
    """One thread for each queue, which ends with the engine.

    ``hears``: whether notifications arrive.
    """

    def __init__(self, engine: DBOS, queues: Sequence[Queue], hears: Callable[[], bool]) -> None:
        self._engine = engine
        self._stops: dict[str, Wakeable] = {}
        for queue in queues:
            stop = self._stops[queue.name] = Wakeable(_holds_work(engine, queue.name), hears)
            thread = threading.Thread(target=self._run, args=(stop, queue), name=f"queue {queue.name}", daemon=True)
            engine.background_thread_stop_events.append(stop)
            engine._background_threads.append(thread)
            thread.start()

    def wake(self, queue: str) -> None:
        """Look for work in a queue; in all of them where the name is empty."""
        for name, stop in self._stops.items():
            if queue in ("", name):
                stop.wake()

    def _run(self, stop: Wakeable, queue: Queue) -> None:
        # It returns before its end only where the queue's row is gone for a moment.
        while not stop.is_set():
            queue_worker_thread(stop, self._engine, queue)


def _holds_work(engine: DBOS, queue: str) -> Callable[[], bool]:
    return lambda: engine._active_workflows_set.count_for_queue(queue) > 0
