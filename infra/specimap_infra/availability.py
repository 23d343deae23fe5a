"""Whether a server answers: one line in the log when it goes away and one when it is back, and quick refusals between.

Where a server hangs, each try takes as long as its time limit. Requests that all tried would fill the threads and wait
for each other without end; so while a server is away, one of them tries at a time and the others are refused at once.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from specimap_core.errors import SpecimapError
from specimap_infra.logs import logger

SLOW_SECONDS = 1.0
"""A try that failed sooner held nobody up."""
RETRY_SECONDS = 1.0
"""How long after a slow one that failed the next try may begin."""
LONGEST_TRY_SECONDS = 30.0
"""How long a try may keep the next one off."""


class Availability:
    """What is known of one server. Safe to share between threads.

    ``error``: of a refusal. ``refuses``: without it, every caller tries, as where a wait is short.
    """

    def __init__(self, name: str, error: Callable[[], SpecimapError], *, refuses: bool) -> None:
        self._name = name
        self._error = error
        self._refuses = refuses
        self._lock = threading.Lock()
        self._away_since: float | None = None
        self._next_try = 0.0

    def enter(self) -> None:
        """Begin a try; raises ``error`` while the server is away and it is not yet time for one."""
        with self._lock:
            if self._away_since is None or not self._refuses:
                return
            if self._next_try == 0.0:
                return
            now = time.monotonic()
            if now < self._next_try:
                raise self._error()
            self._next_try = now + LONGEST_TRY_SECONDS

    def failed(self, cause: BaseException, seconds: float) -> None:
        """Note that a try has failed, after so many seconds."""
        now = time.monotonic()
        with self._lock:
            first = self._away_since is None
            self._away_since = self._away_since or now
            # Where it fails at once everybody may try, and nobody is refused once it is back.
            self._next_try = now + RETRY_SECONDS if seconds > SLOW_SECONDS else 0.0
        if first:
            logger().warning(f"the {self._name} is away", cause=first_line(cause))

    def unknown(self) -> None:
        """Note that a try ended in a way that tells nothing: the next one may begin."""
        with self._lock:
            self._next_try = 0.0

    def answered(self) -> None:
        """Note that the server answers."""
        if self._away_since is None:  # read without the lock: nearly always so
            return
        with self._lock:
            since, self._away_since = self._away_since, None
        if since is not None:
            logger().warning(f"the {self._name} is back", seconds=round(time.monotonic() - since, 1))

    @contextmanager
    def trying(self, is_away: Callable[[BaseException], bool]) -> Iterator[None]:
        """Make a try of the block, which fails by the errors that ``is_away`` picks alone."""
        self.enter()
        start = time.monotonic()
        try:
            yield
        except BaseException as error:
            if is_away(error):
                self.failed(error, time.monotonic() - start)
            else:
                self.unknown()
            raise
        self.answered()


def first_line(error: BaseException) -> str:
    """Return the kind of the error that began it all, and the first line of its text, for the log."""
    chain: Any = error
    while chain.__cause__ is not None:
        chain = chain.__cause__
    lines = str(chain).strip().splitlines()
    return f"{type(chain).__name__}: {lines[0][:300]}" if lines else type(chain).__name__
