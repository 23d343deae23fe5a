"""Landlock: what files, TCP ports and processes a process may reach, given up by itself and never regained.

The kernel's interface is ``Documentation/userspace-api/landlock.rst``. Nothing but the standard library is imported.
"""

from __future__ import annotations

import ctypes
import os
import stat
import struct
import sys
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

CREATE, ADD_RULE, RESTRICT = 444, 445, 446
VERSION, BENEATH = 1, 1
LEAST_ABI = 2
"""Before it no file could be renamed into another folder, which stages do."""
PR_SET_NO_NEW_PRIVS = 38

EXECUTE, WRITE_FILE, READ_FILE, READ_DIR, REMOVE_DIR, REMOVE_FILE = (1 << bit for bit in range(6))
MAKE_CHAR, MAKE_DIR, MAKE_REG, MAKE_SOCK, MAKE_FIFO, MAKE_BLOCK, MAKE_SYM = (1 << bit for bit in range(6, 13))
REFER, TRUNCATE, IOCTL_DEV = 1 << 13, 1 << 14, 1 << 15

READ = READ_FILE | READ_DIR
RUN = READ | EXECUTE
# No links and no special files: the process that takes the results up would follow them.
WRITE = READ | WRITE_FILE | REMOVE_DIR | REMOVE_FILE | MAKE_DIR | MAKE_REG | REFER | TRUNCATE
DEVICE = READ | WRITE_FILE | TRUNCATE | IOCTL_DEV
_OF_FILES = EXECUTE | WRITE_FILE | READ_FILE | TRUNCATE | IOCTL_DEV
_FILES_BY_ABI = {1: 13, 2: 14, 3: 15, 4: 15}
"""How many of the rights above a kernel knows; from ABI 5 on all sixteen."""
_TCP = 0b11
_SCOPES = 0b11
"""No abstract UNIX sockets and no signals beyond the processes that share the restriction."""


@lru_cache(maxsize=1)
def abi() -> int:
    """The version that the kernel offers; 0 where it offers none."""
    if sys.platform != "linux":
        return 0
    return max(0, _call(CREATE, None, 0, VERSION))


@lru_cache(maxsize=1)
def library() -> ctypes.CDLL:
    """The C library, whose calls set ``ctypes.get_errno()``."""
    return ctypes.CDLL(None, use_errno=True)


class Ruleset:
    """Places and rights to them, collected and then enforced. Raises OSError where the kernel refuses."""

    def __init__(self) -> None:
        version = abi()
        self._files = (1 << _FILES_BY_ABI.get(version, 16)) - 1
        attributes = struct.pack("=QQQ", self._files, _TCP if version >= 4 else 0, _SCOPES if version >= 6 else 0)
        self._handle = _checked(CREATE, attributes, len(attributes), 0)

    def allow(self, rules: Iterable[tuple[Path | str, int]]) -> None:
        """Add places; those that do not exist are passed over."""
        for place, rights in rules:
            _allow(self._handle, place, rights & self._files)

    def enforce(self) -> None:
        """Let this thread, and whatever it starts from now on, reach nothing else. Threads that run already are not
        restricted."""
        give_up_new_rights()
        _checked(RESTRICT, self._handle, 0)
        os.close(self._handle)


def give_up_new_rights() -> None:
    """No program that this process runs gains a right; without it an ordinary user may not restrict itself."""
    if library().prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "PR_SET_NO_NEW_PRIVS")


def _allow(ruleset: int, place: Path | str, rights: int) -> None:
    try:
        handle = os.open(place, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not stat.S_ISDIR(os.fstat(handle).st_mode):
            rights &= _OF_FILES
        _checked(ADD_RULE, ruleset, BENEATH, struct.pack("=Qi", rights, handle), 0)
    finally:
        os.close(handle)


def _call(number: int, *arguments: int | bytes | None) -> int:
    passed = (ctypes.c_long(value) if isinstance(value, int) else ctypes.c_char_p(value) for value in arguments)
    return int(library().syscall(ctypes.c_long(number), *passed))


def _checked(number: int, *arguments: int | bytes | None) -> int:
    answer = _call(number, *arguments)
    if answer < 0:
        code = ctypes.get_errno()
        raise OSError(code, f"Landlock: {os.strerror(code)}")
    return answer
