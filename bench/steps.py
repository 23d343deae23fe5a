"""Where a run's seconds go: each step's share, compared with what its libraries alone would take."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.machine import load
from bench.measure import ROOT, Measured, measure
from bench.real import APPLE, EDGE_MM
from bench.sample import SAMPLE
from bench.service.sheet import NONE, Sheet
from bench.step_bounds import BOUNDS
from bench.tracing import TARGETS

START, END, REST = "start-up", "process end", "rest"
ORDER = (START, *dict.fromkeys(target.step for target in TARGETS), REST, END)
IMPORTS = "import bench.child; from bench.tracing import tracing; tracing().__enter__()"
OWN = ("specimap_core", "specimap_infra", "specimap_workers", "specimap_cli", "specimap_validation", "bench")


@dataclass(frozen=True)
class Case:
    """``folder`` with ``photos``, and ``cube`` where there is one; ``markers``: options that name them."""

    name: str
    photos: Path
    cube: Path | None = None
    markers: tuple[str, ...] = ()


def cases(data: Path | None) -> list[Case]:
    """The sample, and phantom A and the real photos where the test data are at hand."""
    found = [Case("sample", SAMPLE / "rgb", SAMPLE / "hsi" / "hsi.hdr")]
    if data is not None and (data / "phantom_a").is_dir():
        found.append(Case("phantom A", data / "phantom_a" / "rgb", data / "phantom_a" / "hsi" / "hsi.hdr"))
    if data is not None and (data / APPLE).is_dir():
        markers = ("--dictionary", "DICT_7X7_1000", "--edge-mm", str(EDGE_MM))
        found.append(Case("42 real photos, stages 1 and 2", data / APPLE / "images", markers=markers))
    return found


def bench_steps(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Each case ``repeats`` times; the steps of the fastest run are printed."""
    value = os.environ.get("SPECIMAP_TEST_DATA")
    imports = import_seconds()
    figures: dict[str, Any] = {"repeats": repeats, "imports": imports, "cases": {}}
    for number, case in enumerate(cases(Path(value) if value else None)):
        out = work / f"steps_{number}"
        given = ["--photos", str(case.photos), *case.markers]
        given += ["--cube", str(case.cube)] if case.cube else []
        runs = [measure([*given, "--out", f"{out}_{k}", "--steps"]) for k in range(repeats)]
        best = min(runs, key=lambda m: m.whole.wall_s)
        bounds = {START: {"wall_s": imports["outside"]}} | bounds_of([*given, "--out", f"{out}_0"])
        figures["cases"][case.name] = {
            "steps": steps_of(best),
            "bounds": bounds,
            "runs": [m.as_dict() for m in runs],
        }
    figures["load_after"] = load()
    for sheet in sheet_steps(figures):
        sheet.show(console)
    if value is None:
        console.print("SPECIMAP_TEST_DATA is not set: only the sample was run.")
    return figures


def steps_of(run: Measured) -> dict[str, dict[str, float]]:
    """Wall and CPU seconds by step, in the order of a run: they add up to the whole."""
    start = run.stages["start"]
    found: dict[str, dict[str, float]] = {START: {"wall_s": start.wall_s, "cpu_s": start.cpu_s}}
    found |= {name: {"wall_s": s["wall_s"], "cpu_s": s["cpu_s"]} for name, s in run.result["steps"].items()}
    staged = sum(cost.wall_s for cost in run.stages.values())
    found[REST] = {
        "wall_s": staged - sum(step["wall_s"] for step in found.values()),
        "cpu_s": run.whole.cpu_s - sum(step["cpu_s"] for step in found.values()),
    }
    # The process says nothing any more while it ends.
    found[END] = {"wall_s": run.whole.wall_s - staged, "cpu_s": 0.0}
    return {name: found[name] for name in ORDER if name in found}


def import_seconds() -> dict[str, float]:
    """Seconds that a run's imports take by ``python -X importtime``: ``all``, and ``outside`` Specimap's own."""
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", IMPORTS], capture_output=True, text=True, check=True, cwd=ROOT
    )
    return imports_in(done.stderr)


def imports_in(said: str) -> dict[str, float]:
    """The sums of what ``-X importtime`` has said."""
    every = outside = 0.0
    for line in said.splitlines():
        own, _, named = line.removeprefix("import time:").partition("|")
        name = named.rpartition("|")[2].strip()
        if not line.startswith("import time:") or not own.strip().isdigit():
            continue
        every += int(own) / 1e6
        outside += int(own) / 1e6 if name.partition(".")[0] not in OWN else 0.0
    return {"all": every, "outside": outside}


def bounds_of(given: list[str]) -> dict[str, dict[str, float]]:
    """Bounds by step, found in a process of their own. Raises RuntimeError with its message if that fails."""
    command = [sys.executable, "-m", "bench.step_bounds", *given]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        raise RuntimeError(f"bench.step_bounds {' '.join(given)} failed:\n{done.stderr}")
    bounds: dict[str, dict[str, float]] = json.loads(done.stdout.splitlines()[-1])
    return bounds


def sheet_steps(figures: dict[str, Any]) -> list[Sheet]:
    """A table a case."""
    sheets = []
    for name, case in figures["cases"].items():
        whole = sum(step["wall_s"] for step in case["steps"].values())
        sheet = Sheet(
            f"Steps of a run, {name}, fastest of {figures['repeats']}",
            ("step", "wall s", "share", "CPU s", "bound s", "of wall", "bound CPU s", "of CPU"),
        )
        for step, spent in case["steps"].items():
            bound = case["bounds"].get(step, {})
            beside = [cell for key in ("wall_s", "cpu_s") for cell in _beside(bound.get(key), spent[key])]
            sheet.rows.append(
                [
                    step,
                    f"{spent['wall_s']:.2f}",
                    f"{100 * spent['wall_s'] / whole:.1f} %",
                    NONE if step == END else f"{spent['cpu_s']:.2f}",
                    *beside,
                ]
            )
        cpu = sum(step["cpu_s"] for step in case["steps"].values())
        sheet.rows.append(["whole", f"{whole:.2f}", "100 %", f"{cpu:.2f}", *[NONE] * 4])
        sheets.append(sheet)
    sheets[-1].notes += [
        "CPU: of all threads while the step ran. Where other work keeps the cores busy, walls of step and bound do not "
        "compare; their CPU seconds do.",
        *(f"Bound of {step}: {what}." for step, what in BOUNDS.items()),
        f"All imports by `-X importtime`: {figures['imports']['all']:.2f} s.",
    ]
    return sheets


def _beside(bound: float | None, spent: float) -> tuple[str, str]:
    if bound is None:
        return NONE, NONE
    return f"{bound:.2f}", f"{100 * bound / spent:.0f} %" if spent > 0 else NONE
