"""Rate limit of requests: a token bucket for each key in each API process."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable

from specimap_service.errors import RateLimitedError

MOST_BUCKETS = 10_000


class RateLimiter:
    """Buckets by name. Each holds a minute's worth of requests and refills evenly."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, name: str, per_minute: int) -> None:
        """Count one request of ``name``.

        Raises:
            RateLimitedError: the bucket is empty; details say when it will not be.
        """
        now = self._clock()
        with self._lock:
            left, at = self._buckets.pop(name, (float(per_minute), now))
            left = min(float(per_minute), left + (now - at) * per_minute / 60)
            allowed = left >= 1
            self._buckets[name] = (left - 1 if allowed else left, now)
            if len(self._buckets) > MOST_BUCKETS:
                self._buckets.popitem(last=False)
        if not allowed:
            wait = max(1, round((1 - left) * 60 / per_minute))
            raise RateLimitedError(
                f"More than {per_minute} requests a minute.", advice=f"Wait {wait} s.", retry_after_s=wait
            )
