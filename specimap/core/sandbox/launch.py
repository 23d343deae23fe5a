"""Confining this process, or a command that is started."""

from __future__ import annotations

import ctypes
import json
import os
import struct
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from specimap.core.sandbox import landlock, seccomp
from specimap.core.sandbox.places import Mode, Reach, Rule, program_rules

NOT_CONFINED = 71
"""Exit status of a command that was not started, since it could not be confined."""
_PR_SET_DUMPABLE, _PR_CAPBSET_DROP = 4, 24
_CAPSET = {"x86_64": 126, "aarch64": 91}
_CAPABILITY_VERSION = 0x20080522

# Without site: what is confined must not depend on what a file of the environment loads. Without the package's own
# __init__, which asks for metadata that is out of reach then.
_LAUNCHER = (
    "import sys, types; package = types.ModuleType('specimap'); package.__path__ = [sys.argv[1]]; "
    "sys.modules['specimap'] = package; from specimap.core.sandbox.launch import main; main(sys.argv[2:])"
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
    plan = json.dumps({"mode": mode, "rules": program_rules(reach)})
    package = str(Path(__file__).resolve().parents[2])
    return [sys.executable, "-I", "-S", "-B", "-c", _LAUNCHER, package, plan, *command]


def confine(rules: Sequence[Rule], mode: Mode, *, alone: bool) -> None:
    """Give up, for good, whatever ``rules`` do not name; ``alone`` as of :func:`seccomp.restrict`.

    Threads that run already keep their reach of files: call it before there are any.

    Raises:
        OSError: not all of it could be given up, and ``mode`` requires that.
    """
    if mode == "off":
        return
    failed: OSError | None = None
    for step in (
        _drop_capabilities,
        lambda: landlock.restrict((Path(place), rights) for place, rights in rules),
        lambda: seccomp.restrict(alone=alone),
    ):
        try:
            step()
        except OSError as error:
            failed = failed or error
    whole = protection().whole
    if mode == "require" and (failed or not whole):
        raise failed or OSError(0, f"The kernel has no {protection().missing}.")


def hide_from_others() -> None:
    """Let no process of the same user look into this one: not at its memory, nor at the keys in its environment."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0)


def _drop_capabilities() -> None:
    """Root without its rights: it can read other users' files no more."""
    library = ctypes.CDLL(None, use_errno=True)
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
        confine([(place, rights) for place, rights in plan["rules"]], plan["mode"], alone=False)
        os.execv(arguments[1], arguments[1:])
    except OSError as error:
        sys.stderr.write(f"The process could not be confined: {error}.\n")
        sys.stderr.flush()
        os._exit(NOT_CONFINED)
