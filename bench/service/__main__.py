"""``python -m bench.service [--only spectrum|cloud|shard|upload|jobs] [--repeats N] [--jobs N]``."""

from __future__ import annotations

import os
import tempfile
from argparse import ArgumentParser
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.machine import describe, in_words
from bench.record import keep
from bench.service.clouds import bench_cloud, sheet_cloud
from bench.service.jobs import bench_jobs, sheet_jobs
from bench.service.options import Options
from bench.service.peer import NO_NGINX, nginx_version
from bench.service.shard import bench_shard, sheet_shard
from bench.service.sheet import Sheet
from bench.service.spectrum import bench_spectrum, sheet_spectrum
from bench.service.upload import bench_upload, sheet_upload

PACKAGES = ("fastapi", "starlette", "uvicorn", "uvloop", "httptools", "dbos", "sqlalchemy", "zarr", "obstore", "httpx")
WIDTH = 130
"""Columns where the output is not a terminal."""
Part = tuple[Callable[[Path, Options], dict[str, Any]], Callable[[dict[str, Any]], list[Sheet]]]
PARTS: dict[str, Part] = {
    "spectrum": (bench_spectrum, sheet_spectrum),
    "cloud": (bench_cloud, sheet_cloud),
    "shard": (bench_shard, sheet_shard),
    "upload": (bench_upload, sheet_upload),
    "jobs": (bench_jobs, sheet_jobs),
}


def machine() -> dict[str, object]:
    """As of the other benchmarks, with the service's libraries and the peer."""
    found = describe()
    versions = found["versions"]
    assert isinstance(versions, dict)
    found["versions"] = versions | {name: version(name) for name in PACKAGES} | {"nginx": nginx_version()}
    return found


def main() -> None:
    """Run the parts asked for, print their tables, keep their figures."""
    parser = ArgumentParser(prog="python -m bench.service", description=__doc__)
    parser.add_argument("--only", choices=PARTS, action="append", help="run this part; may be repeated")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each measurement; the fastest is printed")
    parser.add_argument("--jobs", type=int, default=3, help="jobs, and as many reruns")
    given = parser.parse_args()
    options = Options(max(1, given.repeats), max(1, given.jobs))
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    here = machine()
    console.print(f"{in_words(here)}, {options.repeats} repeats", highlight=False)
    versions = here["versions"]
    assert isinstance(versions, dict)
    console.print(", ".join(f"{name} {versions[name]}" for name in versions if versions[name]), highlight=False)
    if nginx_version() is None:
        console.print(NO_NGINX, highlight=False)
    with tempfile.TemporaryDirectory(prefix="specimap-bench-") as scratch:
        for name in given.only or PARTS:
            bench, sheets = PARTS[name]
            before = machine()
            figures = bench(Path(scratch), options)
            figures["load_after"] = round(os.getloadavg()[0], 2)
            for sheet in sheets(figures):
                sheet.show(console)
            console.print(f"Kept in {keep(f'service-{name}', figures, before)}", highlight=False, soft_wrap=True)


if __name__ == "__main__":
    main()
