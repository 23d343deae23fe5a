"""Folders made once for all processes of a test run: phantoms, and runs of the pipeline on them."""

from __future__ import annotations

import fcntl
import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest


@dataclass(frozen=True)
class SharedFolders:
    """Folders under ``root``, each made by the first process that asks for it; the others wait."""

    root: Path

    def made(self, name: str, recipe: object, make: Callable[[Path], object]) -> Path:
        """The folder of a recipe, which ``make`` fills where it is not there yet. Nobody writes to it afterwards.

        ``recipe``: whatever its content depends on; its ``repr`` is the key.
        """
        key = hashlib.sha256(repr(recipe).encode()).hexdigest()[:12]
        folder = self.root / f"{name}-{key}"
        with open(self.root / f"{folder.name}.lock", "w", encoding="ascii") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                # Whoever fails leaves a part of it.
                unfinished = Path(tempfile.mkdtemp(prefix=f"{folder.name}.", dir=self.root))
                make(unfinished)
                unfinished.rename(folder)
        return folder


@contextmanager
def _memory_kills(shared_folders: SharedFolders, kind: int) -> Iterator[None]:
    with open(shared_folders.root / "memory-kills.lock", "w", encoding="ascii") as lock:
        fcntl.flock(lock, kind)
        yield


@pytest.fixture
def memory_kills(shared_folders: SharedFolders) -> Iterator[None]:
    """For a test that has the kernel kill processes for want of memory, which it counts for the whole machine."""
    with _memory_kills(shared_folders, fcntl.LOCK_EX):
        yield


@pytest.fixture
def no_memory_kills(shared_folders: SharedFolders) -> Iterator[None]:
    """For a test that tells other kills from those: none of them happens meanwhile."""
    with _memory_kills(shared_folders, fcntl.LOCK_SH):
        yield


@pytest.fixture(scope="session")
def shared_folders(tmp_path_factory: pytest.TempPathFactory) -> SharedFolders:
    """Folders that all processes of this test run share."""
    own = tmp_path_factory.getbasetemp()
    # With xdist each process has a folder of its own in that of the run.
    root = (own.parent if os.environ.get("PYTEST_XDIST_WORKER") else own) / "shared"
    root.mkdir(exist_ok=True)
    return SharedFolders(root)
