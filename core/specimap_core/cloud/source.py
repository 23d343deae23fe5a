"""Sources of the bytes of a stored cloud: a folder, or whatever else reads parts of named files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol


class ByteSource(Protocol):
    """The files of one group. Safe to share between threads.

    ``name`` stands in messages. Both methods raise FileNotFoundError where there is no such file.
    """

    @property
    def name(self) -> str: ...

    def size(self, key: str) -> int:
        """Bytes of the file ``key``, a relative path with slashes."""

    def read(self, key: str, start: int = 0, stop: int | None = None) -> bytes:
        """Its bytes from ``start`` up to ``stop``; fewer where the file ends before."""


@dataclass(frozen=True)
class Folder:
    """A group in a local folder."""

    path: Path

    @property
    def name(self) -> str:
        """The folder's name."""
        return self.path.name

    def size(self, key: str) -> int:
        """See :class:`ByteSource`."""
        return (self.path / key).stat().st_size

    def read(self, key: str, start: int = 0, stop: int | None = None) -> bytes:
        """See :class:`ByteSource`."""
        with open(self.path / key, "rb") as file:
            file.seek(start)
            return file.read() if stop is None else file.read(stop - start)
