"""Cache of drawn pictures in memory, up to a number of bytes."""

from __future__ import annotations

import threading
from collections import OrderedDict

from specimap_service.clouds.pictures import Picture

MOST_BYTES = 128 * 1024**2


class PictureCache:
    """Pictures by tag; the least recently used ones are dropped first. Safe to share between threads."""

    def __init__(self, most_bytes: int = MOST_BYTES) -> None:
        self._most = most_bytes
        self._kept: OrderedDict[str, Picture] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    @property
    def kept_bytes(self) -> int:
        """Bytes of all cached pictures."""
        return self._bytes

    def find(self, tag: str) -> Picture | None:
        """Return the picture of a tag, if it is kept."""
        with self._lock:
            found = self._kept.get(tag)
            if found is not None:
                self._kept.move_to_end(tag)
            return found

    def keep(self, tag: str, picture: Picture) -> None:
        """Keep a picture, and drop others where there is no room."""
        with self._lock:
            if tag not in self._kept:
                self._kept[tag] = picture
                self._bytes += len(picture.png)
            while self._bytes > self._most:
                _, dropped = self._kept.popitem(last=False)
                self._bytes -= len(dropped.png)
