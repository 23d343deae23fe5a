"""Threads of the libraries below numpy, set before numpy is loaded: so nothing is imported here."""

from __future__ import annotations

import os


def limit_blas_threads() -> None:
    """Let OpenBLAS use one thread in this process and its children, unless the user's environment says otherwise.

    OpenBLAS reads the variable once, when numpy is first imported, so a program's entry point calls this before that.
    The matrices here are small and the stages start threads of their own: a BLAS that starts more for each of them
    makes them wait for one another (the markers' solve takes 15 times as long on a busy machine).
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
