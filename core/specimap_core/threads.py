"""Threads of the libraries below numpy, set before numpy is loaded, and the rank of a process among others: so nothing
is imported here."""

from __future__ import annotations

import os
from contextlib import suppress

NICENESS = 5
"""Leaves a quarter of a core where processes of usual rank want it too: behind answers, without being starved."""


def limit_blas_threads() -> None:
    """Let OpenBLAS use one thread in this process and its children, unless the user's environment says otherwise.

    OpenBLAS reads the variable once, when numpy is first imported, so a program's entry point calls this before that.
    The matrices here are small and the stages start threads of their own: a BLAS that starts more for each of them
    makes them wait for one another (the markers' solve takes 15 times as long on a busy machine).
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def step_back() -> None:
    """Let this process and its children give way to processes of usual rank, such as the one that answers requests."""
    with suppress(OSError):
        os.nice(NICENESS)
    # Linux may rank processes within their session only, and the sessions by this: for one that began its own.
    if os.getsid(0) == os.getpid():
        with suppress(OSError), open("/proc/self/autogroup", "w", encoding="ascii") as rank:
            rank.write(str(NICENESS))
