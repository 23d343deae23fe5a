"""Results are kept: one JSON file a run, never overwritten."""

from __future__ import annotations

import datetime
from pathlib import Path

from bench.machine import describe
from specimap_core.atomic import write_text
from specimap_core.json_text import json_text

RESULTS = Path(__file__).parent / "results"


def keep(part: str, figures: object, machine: dict[str, object] | None = None) -> Path:
    """Write ``figures`` with machine and time into ``bench/results/``; the path written."""
    now = datetime.datetime.now(datetime.UTC)
    path = RESULTS / f"{now:%Y%m%dT%H%M%SZ}-{part}.json"
    document = {"part": part, "time": now.isoformat(timespec="seconds"), "machine": machine or describe()}
    write_text(path, json_text(document | {"figures": figures}, indent=1))
    return path
