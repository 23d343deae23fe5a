"""The parts of the benchmark: what measures each, and what tables it gives."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from bench.machine import in_words
from bench.service.clouds import bench_cloud, sheet_cloud
from bench.service.jobs import bench_jobs, sheet_jobs
from bench.service.neighbour import bench_neighbour, sheet_neighbour
from bench.service.options import Options
from bench.service.pages import bench_pages, sheet_pages
from bench.service.scale import bench_scale
from bench.service.scale_sheets import sheet_scale
from bench.service.shard import bench_shard, sheet_shard
from bench.service.sheet import Sheet
from bench.service.spectrum import bench_spectrum, sheet_spectrum
from bench.service.upload import bench_upload, sheet_upload

Figures = dict[str, Any]
PARTS: dict[str, tuple[Callable[[Path, Options], Figures], Callable[[Figures], list[Sheet]]]] = {
    "spectrum": (bench_spectrum, sheet_spectrum),
    "cloud": (bench_cloud, sheet_cloud),
    "shard": (bench_shard, sheet_shard),
    "upload": (bench_upload, sheet_upload),
    "jobs": (bench_jobs, sheet_jobs),
    "neighbour": (bench_neighbour, sheet_neighbour),
    "scale": (bench_scale, sheet_scale),
    "pages": (bench_pages, sheet_pages),
}


def in_markdown(part: str, record: dict[str, Any]) -> str:
    """The tables of a kept record, and what they were measured on, for a document."""
    figures, machine = record["figures"], record["machine"]
    versions = machine["versions"]
    peers = "".join(f", {name} {versions[name]}" for name in ("nginx", "tiled") if versions.get(name))
    tables = [sheet.markdown() for sheet in PARTS[part][1](figures)]
    return "\n\n".join([*tables, f"{in_words(machine)}, {figures['load_after']} after{peers}; {record['time'][:10]}."])
