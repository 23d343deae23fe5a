"""Rate limit of requests: a token bucket for each key in each API process."""

from __future__ import annotations

import math
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from specimap_service.errors import RateLimitedError

MOST_BUCKETS = 10_000


@dataclass(frozen=True)
class Left:
    """Requests that are left of ``per_minute``; after ``full_s`` seconds all are there again."""

    per_minute: int
    requests: int
    full_s: int

    def headers(self) -> dict[str, str]:
        """Return the fields of the IETF's draft-ietf-httpapi-ratelimit-headers."""
        return {
            "RateLimit-Policy": f'"key";q={self.per_minute};w=60',
            "RateLimit": f'"key";r={self.requests};t={self.full_s}',
        }


class RateLimiter:
    """Buckets by name. Each holds a minute's worth of requests and refills evenly."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def take(self, name: str, per_minute: int) -> Left:
        """Count one request of ``name``; return how many are left.

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
                f"More than {per_minute} requests a minute.",
                advice=f"Wait {wait} s.",
                retry_after_s=wait,
            )
        return Left(per_minute, int(left - 1), math.ceil((per_minute - left + 1) * 60 / per_minute))
