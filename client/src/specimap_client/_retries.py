"""When and how long to wait before a request is sent again."""

from __future__ import annotations

import random
import time
from dataclasses import dataclass

IDEMPOTENT = frozenset({"GET", "HEAD", "PUT", "DELETE", "OPTIONS"})
TRANSIENT = frozenset({502, 503, 504})
RATE_LIMITED = 429


@dataclass(frozen=True)
class Retries:
    """How often a request that is safe to repeat is repeated, and how long is waited between.

    The k-th wait is drawn between half and all of ``first_s * 2**k``, at most ``cap_s``; where the service says
    how long (429, 503), that long. A service that says longer than ``longest_s`` is not waited for.
    """

    attempts: int = 6
    first_s: float = 0.5
    cap_s: float = 20.0
    longest_s: float = 120.0

    def __post_init__(self) -> None:
        if self.attempts < 1:
            raise ValueError("attempts is at least 1")

    def delay(self, attempt: int, retry_after: float | None = None) -> float:
        """Seconds to wait after the attempt, counted from 0."""
        # Jitter: clients that a restart cut off at once must not come back at once.
        jitter = random.uniform(0.5, 1.0)  # noqa: S311 - keeps no secret
        wait: float = min(self.cap_s, self.first_s * 2 ** min(attempt, 30)) * jitter
        return wait if retry_after is None else max(retry_after, 0.0) + wait * 0.1


def seconds_of(header: str | None) -> float | None:
    """``Retry-After`` in seconds; None where it is absent or not a number, such as a date."""
    try:
        return None if header is None else float(header)
    except ValueError:
        return None


def sleep(seconds: float) -> None:
    """Wait."""
    time.sleep(seconds)
