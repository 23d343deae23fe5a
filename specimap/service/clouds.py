"""Open clouds, kept for the next request."""

from __future__ import annotations

from specimap.infra.storage import Storage


class OpenClouds:
    """To be filled."""

    def __init__(self, storage: Storage) -> None:
        self._storage = storage
