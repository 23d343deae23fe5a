"""The options of a run of the benchmark."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Options:
    """``repeats``: of each measurement; ``jobs``: how many jobs are run."""

    repeats: int
    jobs: int
