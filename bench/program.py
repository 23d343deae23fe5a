"""``python -m bench [--only PART] [--repeats N]``."""

from __future__ import annotations

import tempfile
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from bench.accuracy import bench_accuracy
from bench.budget import bench_budget
from bench.cube import bench_cube
from bench.features import bench_features
from bench.growth import bench_growth
from bench.machine import describe, in_words
from bench.photos import bench_photos
from bench.record import keep
from bench.sample import bench_sample
from bench.sigma import bench_sigma
from bench.steps import bench_steps

Part = Callable[[Console, Path, int], dict[str, object]]
PARTS: dict[str, Part] = {
    "sample": bench_sample,
    "steps": bench_steps,
    "cube": bench_cube,
    "growth": bench_growth,
    "photos": bench_photos,
    "accuracy": bench_accuracy,
    "budget": bench_budget,
    "sigma": bench_sigma,
    "features": bench_features,
}

WIDTH = 130
"""Columns where the output is not a terminal."""


def main() -> None:
    """Run the parts asked for, print their tables, keep their figures."""
    parser = ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("--only", choices=PARTS, action="append", help="run this part; may be repeated")
    parser.add_argument("--repeats", type=int, default=1, help="runs of each measurement; the fastest is printed")
    options = parser.parse_args()
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    console.print(in_words(describe()), highlight=False)
    with tempfile.TemporaryDirectory(prefix="specimap-bench-") as scratch:
        for name in options.only or PARTS:
            machine = describe()
            figures = PARTS[name](console, Path(scratch), max(1, options.repeats))
            console.print(f"Kept in {keep(name, figures, machine)}", highlight=False, soft_wrap=True)
