"""The kernel's killing of processes for want of memory: told apart from other kills, and led away from the worker."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from specimap_infra.logs import logger

FIRST = "1000"
"""Highest value of ``oom_score_adj``: the kernel takes these processes before all others."""


def memory_kills() -> int | None:
    """Return how many processes the kernel has killed for want of memory since it started; None if it does not say."""
    try:
        lines = Path("/proc/vmstat").read_text("ascii").splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) for line in lines if line.startswith("oom_kill ")), None)


class MemoryWatch:
    """Tells whether the kernel has killed some process for want of memory since this was made."""

    def __init__(self) -> None:
        self._before = memory_kills()

    def ran_out(self) -> bool:
        """Whether it has, of whatever process: one too many is a crash that counts, of which several are needed."""
        return memory_kills() != self._before


def offer_to_memory_killer(pid: int) -> None:
    """Have the kernel kill a child, and what it starts, before its worker: the worker can then say what happened."""
    with suppress(FileNotFoundError, ProcessLookupError):
        try:
            Path(f"/proc/{pid}/oom_score_adj").write_text(FIRST, "ascii")
        except PermissionError:
            logger().debug("the kernel may kill the worker before its stage, for want of memory")
