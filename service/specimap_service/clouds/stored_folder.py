"""A folder of the storage, as the reader of clouds wants it."""

from __future__ import annotations

from dataclasses import dataclass

from specimap_infra.storage import Storage


@dataclass(frozen=True)
class StoredFolder:
    """Files below a prefix of the storage, as the reader of clouds wants them."""

    storage: Storage
    prefix: str

    @property
    def name(self) -> str:
        """The last part of the prefix."""
        return self.prefix.rpartition("/")[2]

    def size(self, key: str) -> int:
        """Return the size of a file, bytes. Raises NotFoundError, StorageUnavailableError."""
        return self.storage.stat(f"{self.prefix}/{key}").size

    def read(self, key: str, start: int = 0, stop: int | None = None) -> bytes:
        """Read the bytes of a file. Raises NotFoundError, StorageUnavailableError."""
        return self.storage.read(f"{self.prefix}/{key}", start, stop)
