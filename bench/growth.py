"""How stage 4 grows with the size of the cube; the exponents of growth that other parts print, too."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from bench.machine import available_bytes, load
from bench.measure import measure
from bench.sample import SAMPLE, run_sample
from bench.service.sheet import Sheet
from bench.synthetic import BANDS, COLS, ROWS, enlarge, write_envi_cube

FACTORS = (0.25, 0.5, 1.0, 2.0, 4.0)
"""Sizes of the cubes in bytes, over that of a full-size one."""
QUANTITIES = {"wall": "wall_s", "cpu": "cpu_s", "memory": "peak_mb"}
MEMORY_SHARE = 2.5
"""Memory wanted, in sizes of the cube: it is made in memory, then lies in the page cache with the cloud."""
DISK_SHARE = 2.0
"""Disk wanted, in sizes of the cube: the cube, and a cloud that compresses no better than noise."""
SPARE_BYTES = 2_000_000_000


def exponents(sizes: Sequence[float], costs: Sequence[dict[str, float]]) -> dict[str, dict[str, float]]:
    """Powers of the size with which wall time, CPU time and memory grow: the slope over all sizes on logarithmic axes
    (``all``), and that between the last two (``last``), where what does not grow counts least."""
    found: dict[str, dict[str, float]] = {}
    for name, key in QUANTITIES.items():
        values = [cost[key] for cost in costs]
        found[name] = {"all": _slope(sizes, values), "last": _slope(sizes[-2:], values[-2:])}
    return found


def exponents_in_words(found: dict[str, dict[str, float]], by: str) -> str:
    """One sentence; ``by``: the letter of the size."""
    over_all = ", ".join(f"{by}^{slope['all']:.2f} ({name})" for name, slope in found.items())
    last = ", ".join(f"{slope['last']:.2f}" for slope in found.values())
    return f"Over all sizes: {over_all}; between the last two: {last}."


def _slope(sizes: Sequence[float], values: Sequence[float]) -> float:
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def shape_of(factor: float) -> tuple[int, int]:
    """Rows and columns, both even, of a cube ``factor`` times as large as a full-size one, of the same bands."""
    side = math.sqrt(factor)
    return 2 * round(ROWS * side / 2), 2 * round(COLS * side / 2)


def lacking(size: int, free_disk: int, free_memory: int) -> str | None:
    """Why a cube of ``size`` bytes cannot be measured here; None where it can."""
    for what, share, free in (("disk", DISK_SHARE, free_disk), ("memory", MEMORY_SHARE, free_memory)):
        wanted = share * size + SPARE_BYTES
        if free < wanted:
            return f"{wanted / 1e9:.1f} GB of {what} wanted, {free / 1e9:.1f} GB free"
    return None


def bench_growth(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Stage 4 on uint16 BIL cubes of each size, ``repeats`` times; what does not fit the machine is left out."""
    run = work / "sample_0"
    if not (run / "report.json").is_file():
        run_sample(run)
    sizes: dict[str, dict[str, object]] = {}
    for factor in FACTORS:
        rows, cols = shape_of(factor)
        about: dict[str, object] = {"rows": rows, "cols": cols, "bytes": 2 * rows * cols * BANDS}
        reason = lacking(2 * rows * cols * BANDS, shutil.disk_usage(work).free, available_bytes())
        if reason is None:
            runs = _runs(run, work, rows, cols, repeats)
            best = min(runs, key=lambda m: m["stages"]["register"]["wall_s"])
            about |= {"register": best["stages"]["register"], "points": best["result"]["points"], "runs": runs}
        else:
            about["skipped"] = reason
        sizes[f"{factor:g}"] = about
    figures: dict[str, object] = {"sizes": sizes, "repeats": repeats}
    done: list[Any] = [about for about in sizes.values() if "register" in about]
    if len(done) > 1:
        figures["exponent"] = exponents([s["bytes"] for s in done], [s["register"] for s in done])
    figures["load_after"] = load()
    for sheet in sheet_growth(figures):
        sheet.show(console)
    return figures


def _runs(run: Path, work: Path, rows: int, cols: int, repeats: int) -> list[dict[str, Any]]:
    header, out = work / "grown.hdr", work / "grown_out"
    # The cube is made and let go here, so that its memory is free while stage 4 is measured.
    write_envi_cube(enlarge(SAMPLE / "hsi" / "hsi.hdr", rows, cols), header, "uint16", "bil")
    os.sync()  # the cube's own pages must not be on their way to the disk while the cloud is written
    runs = [measure(["--run", str(run), "--cube", str(header), "--out", str(out)]) for _ in range(repeats)]
    header.with_suffix(".raw").unlink()
    shutil.rmtree(out)
    return [m.as_dict() for m in runs]


def sheet_growth(figures: dict[str, Any]) -> list[Sheet]:
    """The table of kept figures."""
    sheet = Sheet(
        f"Stage 4 by size of the cube (1 = {COLS} x {ROWS} x {BANDS}, uint16 BIL), fastest of {figures['repeats']}",
        ("size", "cube", "GB", "points", "wall s", "CPU s", "peak MB", "wall s/GB", "peak MB/GB"),
    )
    for factor, about in figures["sizes"].items():
        gigabytes = about["bytes"] / 1e9
        row = [factor, f"{about['cols']} x {about['rows']}", f"{gigabytes:.2f}"]
        if "skipped" in about:
            sheet.rows.append([*row, *"------"])
            sheet.notes.append(f"Size {factor} was left out: {about['skipped']}.")
            continue
        cost = about["register"]
        sheet.rows.append(
            [
                *row,
                f"{about['points']:,}",
                f"{cost['wall_s']:.2f}",
                f"{cost['cpu_s']:.2f}",
                f"{cost['peak_mb']:.0f}",
                f"{cost['wall_s'] / gigabytes:.2f}",
                f"{cost['peak_mb'] / gigabytes:.0f}",
            ]
        )
    if "exponent" in figures:
        sheet.notes.append(exponents_in_words(figures["exponent"], "b"))
    sheet.notes.append("b: bytes of the cube. Peak: memory of the process beyond mapped files and libraries.")
    return [sheet]
