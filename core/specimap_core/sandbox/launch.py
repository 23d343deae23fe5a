"""Confining this process, or a command that is started."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import struct
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from specimap_core.sandbox import landlock, seccomp
from specimap_core.sandbox.places import Mode, Reach, Rule, program_rules

NOT_CONFINED = 71
"""Exit status of a command that was not started, since it could not be confined."""
_PR_SET_DUMPABLE, _PR_CAPBSET_DROP = 4, 24
_CAPSET = {"x86_64": 126, "aarch64": 91}
_CAPABILITY_VERSION = 0x20080522

# Without site: what is confined must not depend on what a file of the environment loads. Without the package's own
# __init__, which asks for metadata that is out of reach then.
_LAUNCHER = (
    "import sys, types; package = types.ModuleType('specimap_core'); package.__path__ = [sys.argv[1]]; "
    "sys.modules['specimap_core'] = package; from specimap_core.sandbox.launch import main; main(sys.argv[2:])"
)


@dataclass(frozen=True)
class Protection:
    """What the kernel offers: Landlock's version (0: none), and whether calls can be filtered."""

    landlock: int
    seccomp: bool

    @property
    def whole(self) -> bool:
        """Whether a confined process can open no other file and no connection."""
        return self.landlock >= landlock.LEAST_ABI and self.seccomp

    @property
    def missing(self) -> str:
        """What is not there, in words; empty where nothing is missing."""
        found = [] if self.landlock >= landlock.LEAST_ABI else ["Landlock"]
        return " and ".join([*found, *([] if self.seccomp else ["seccomp"])])


@lru_cache(maxsize=1)
def protection() -> Protection:
    """What there is on this machine."""
    return Protection(landlock.abi(), seccomp.available())


def confined(command: Sequence[str], reach: Reach, mode: Mode) -> list[str]:
    """A command that runs ``command`` where it reaches its program and ``reach`` alone; itself where ``mode`` is off.

    The process is the same: its id, its parent and its open pipes are those of the command.
    """
    if mode == "off":
        return list(command)
    plan = json.dumps({"mode": mode, "rules": program_rules(reach)}, allow_nan=False)
    package = str(Path(__file__).resolve().parents[1])
    return [sys.executable, "-I", "-S", "-B", "-c", _LAUNCHER, package, plan, *command]


class Confinement:
    """Gives up, for good, whatever ``rules`` do not name: what can be done ahead at once, the rest by :meth:`enter`."""

    def __init__(self, rules: Sequence[Rule], mode: Mode) -> None:
        self._mode = mode
        self._failed: OSError | None = None
        self._ruleset: landlock.Ruleset | None = None
        if mode != "off":
            self._attempt(_drop_capabilities)
            self._attempt(lambda: self._collect(rules))

    def enter(self, more: Sequence[Rule] = (), *, alone: bool) -> None:
        """Reach nothing but the rules and ``more`` from now on; ``alone`` as of :func:`seccomp.restrict`.

        Threads that run already keep their reach of files: call it before there are any.

        Raises:
            OSError: not all of it could be given up, and the mode requires that.
        """
        if self._mode == "off":
            return
        self._attempt(lambda: self._enforce(more))
        self._attempt(lambda: seccomp.restrict(alone=alone))
        if self._mode == "require" and (self._failed or not protection().whole):
            raise self._failed or OSError(0, f"The kernel has no {protection().missing}.")

    def _collect(self, rules: Sequence[Rule]) -> None:
        if landlock.abi() < landlock.LEAST_ABI:
            raise OSError(errno.ENOSYS, "Landlock: the kernel has none that is of use")
        self._ruleset = landlock.Ruleset()
        self._ruleset.allow(rules)

    def _enforce(self, more: Sequence[Rule]) -> None:
        if self._ruleset is not None:
            self._ruleset.allow(more)
            self._ruleset.enforce()

    def _attempt(self, step: Callable[[], None]) -> None:
        try:
            step()
        except OSError as error:
            self._failed = self._failed or error


def hide_from_others() -> None:
    """Let no process of the same user look into this one: not at its memory, nor at the keys in its environment."""
    if sys.platform == "linux":
        landlock.library().prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


def _drop_capabilities() -> None:
    """Root without its rights: it can read other users' files no more."""
    library = landlock.library()
    for capability in range(64):
        library.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0)
    number = _CAPSET.get(os.uname().machine)
    if number is not None:
        header, none = struct.pack("=Ii", _CAPABILITY_VERSION, 0), bytes(24)
        if library.syscall(ctypes.c_long(number), header, none):
            code = ctypes.get_errno()
            raise OSError(code, f"capset: {os.strerror(code)}")


def main(arguments: list[str]) -> None:
    """Run a command, confined: its plan as JSON, then the command. Does not return."""
    plan = json.loads(arguments[0])
    try:
        Confinement([(place, rights) for place, rights in plan["rules"]], plan["mode"]).enter(alone=False)
        os.execv(arguments[1], arguments[1:])  # noqa: S606 - a command of Specimap's own
    except OSError as error:
        sys.stderr.write(f"The process could not be confined: {error}.\n")
        sys.stderr.flush()
        os._exit(NOT_CONFINED)
