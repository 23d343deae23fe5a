"""Workspaces: the folders that a stage's or an export's process reaches, apart from its program.

A process gives up access to everything else before it loads a library, and so before it is known which job it will
serve. So the job comes to the process: its folders are moved into the workspace for the time of a stage, and back
after it.
"""

from __future__ import annotations

import os
import stat
import uuid
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from specimap_core.atomic import disk_errors, remove
from specimap_core.reconstruct.backends.environment import UNCONFIGURED, BackendSettings
from specimap_core.sandbox import Mode, Reach, confined
from specimap_core.sandbox.environment import bare_environment
from specimap_core.sandbox.places import interpreter_places
from specimap_infra.settings import ServiceSettings


@dataclass(frozen=True)
class Workspace:
    """``given``: what the process may read; ``own``: what it may write; ``scratch``: its temporary files."""

    folder: Path

    @property
    def given(self) -> Path:
        """Read by the process."""
        return self.folder / "given"

    @property
    def own(self) -> Path:
        """Written by the process."""
        return self.folder / "own"

    @property
    def scratch(self) -> Path:
        """Temporary files of the process."""
        return self.folder / "tmp"

    @contextmanager
    def holding(self, inputs: Path, out: Path) -> Iterator[tuple[Path, Path]]:
        """Have a job's folders in the workspace, ``inputs`` to read and ``out`` to write; gives their places there.

        They are moved back when the block ends; by then the process has ended, or its hold on them has.
        """
        here = self.given / inputs.name, self.own / out.name
        moved = []
        try:
            for source, target in zip((inputs, out), here, strict=True):
                with disk_errors(target):
                    source.rename(target)
                moved.append((source, target))
            yield here
        finally:
            for source, target in moved:
                with suppress(FileNotFoundError):
                    target.rename(source)

    def remove(self) -> None:
        """Remove it with all that is left in it."""
        remove(self.folder)


@dataclass(frozen=True)
class Workspaces:
    """Makes workspaces in a folder, as ``<name>.<suffix>``, and commands that are confined to one."""

    folder: Path
    suffix: str
    mode: Mode
    private: Sequence[Path]
    backends: BackendSettings = UNCONFIGURED

    @classmethod
    def of(
        cls, settings: ServiceSettings, folder: Path, suffix: str, backends: BackendSettings = UNCONFIGURED
    ) -> Workspaces:
        """As the settings say."""
        return cls(folder, suffix, settings.sandbox, settings.private_places, backends)

    def new(self, name: str = "") -> Workspace:
        """An empty workspace, by default under a new name; ``name`` must not be there yet."""
        workspace = Workspace(self.folder / f"{name or f'workspace-{uuid.uuid4().hex[:12]}'}.{self.suffix}")
        for part in (workspace.given, workspace.own, workspace.scratch):
            with disk_errors(part):
                part.mkdir(parents=True, mode=0o700)
        return workspace

    def confined(self, command: Sequence[str], workspace: Workspace, *, backends: bool) -> list[str]:
        """The command, which reaches the workspace alone, and with ``backends`` what the settings name of these."""
        more = backend_reach(self.backends) if backends and self.mode != "off" else Reach()
        reach = Reach(
            (*more.read, workspace.given), (*more.write, workspace.own, workspace.scratch), more.run, self.private
        )
        return confined(command, reach, self.mode)

    def environment(self, workspace: Workspace, keep: Sequence[str] = ()) -> dict[str, str]:
        """Without secrets, with a place for temporary files."""
        return {**bare_environment(keep), "TMPDIR": str(workspace.scratch)}


def backend_reach(backends: BackendSettings) -> Reach:
    """What is named for backends with a network: checkouts, weights, interpreters, and MASt3R's cache."""
    first, second = backends.mast3r, backends.da3
    run = [path for path in (first.home, second.home) if path is not None]
    for python in (first.python, second.python):
        run += interpreter_places(python) if python else []
    weights = [path for path in (first.weights, second.weights) if path is not None]
    write = [first.cache] if first.cache is not None else []
    for path in write:
        with disk_errors(path):
            path.mkdir(parents=True, exist_ok=True)
    return Reach(read=[real for path in weights for real in _targets(path)], write=write, run=run)


def _targets(path: Path) -> Iterator[Path]:
    """A file or folder, and what the links in it name: some keep weights so."""
    yield path
    if path.is_dir():
        yield from (part for part in path.iterdir() if part.is_symlink())


def is_plain(folder: Path) -> bool:
    """Whether a folder holds files and folders alone: nothing that leads elsewhere, or waits for a writer."""
    for parent, folders, files in os.walk(folder):
        for name in (*folders, *files):
            mode = os.lstat(os.path.join(parent, name)).st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                return False
    return True
