"""``python -m bench.service [--only PART] [--repeats N] [--jobs N]``; parts: :mod:`bench.service.parts`."""

from __future__ import annotations

import os
import tempfile
from argparse import ArgumentParser
from importlib.metadata import version
from pathlib import Path

from rich.console import Console

from bench.machine import describe, in_words
from bench.record import keep
from bench.service.databases import postgres_version
from bench.service.options import Options
from bench.service.parts import PARTS
from bench.service.peer import NO_NGINX, NO_TILED, nginx_version, tiled_version

PACKAGES = (
    *("fastapi", "starlette", "uvicorn", "uvloop", "httptools", "dbos", "sqlalchemy", "psycopg"),
    *("zarr", "obstore", "httpx"),
)
WIDTH = 130
"""Columns where the output is not a terminal."""


def machine() -> dict[str, object]:
    """As of the other benchmarks, with the service's libraries and the peer."""
    found = describe()
    versions = found["versions"]
    assert isinstance(versions, dict)
    found["versions"] = (
        versions
        | {name: version(name) for name in PACKAGES}
        | {"nginx": nginx_version(), "tiled": tiled_version(), "postgresql": postgres_version()}
    )
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
    if tiled_version() is None:
        console.print(NO_TILED, highlight=False)
    with tempfile.TemporaryDirectory(prefix="specimap-bench-") as scratch:
        for name in given.only or PARTS:
            bench, sheets = PARTS[name]
            before = machine()
            figures = bench(Path(scratch), options)
            figures |= {"repeats": options.repeats, "load_after": round(os.getloadavg()[0], 2)}
            for sheet in sheets(figures):
                sheet.show(console)
            console.print(f"Kept in {keep(f'service-{name}', figures, before)}", highlight=False, soft_wrap=True)
