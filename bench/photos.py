"""How time and memory grow with the number of photos of one specimen."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from rich.console import Console

from bench.growth import exponents, exponents_in_words
from bench.machine import load
from bench.measure import measure
from bench.service.sheet import Sheet, reached
from specimap_validation.phantom import PhantomSettings, write_phantom

COUNTS = (12, 24, 48, 96)
TARGET = 1.3


def bench_photos(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Whole runs on 12 to 96 photos of a phantom; the exponents of wall time, CPU time and memory."""
    source = work / "phantom"
    write_phantom(PhantomSettings(photos=max(COUNTS), bands=4), source)
    photos = sorted((source / "rgb").iterdir())
    runs: dict[str, list[dict[str, Any]]] = {}
    for count in COUNTS:
        folder = work / f"photos_{count}"
        folder.mkdir(exist_ok=True)
        for photo in photos[:: max(COUNTS) // count]:
            shutil.copyfile(photo, folder / photo.name)
        header = str(source / "hsi" / "hsi.hdr")
        runs[str(count)] = [
            measure(["--photos", str(folder), "--cube", header, "--out", f"{folder}_{k}"]).as_dict()
            for k in range(repeats)
        ]
    exponent = exponents(COUNTS, [_best(found)["whole"] for found in runs.values()])
    figures: dict[str, object] = {"runs": runs, "exponent": exponent, "repeats": repeats, "load_after": load()}
    for sheet in sheet_photos(figures):
        sheet.show(console)
    return figures


def sheet_photos(figures: dict[str, Any]) -> list[Sheet]:
    """The table of kept figures."""
    sheet = Sheet(
        f"Whole run by number of photos, fastest of {figures['repeats']}",
        ("photos", "used", "wall s", "CPU s", "reconstruct s", "bundle-adjust s", "peak MB"),
    )
    for count, runs in figures["runs"].items():
        best = _best(runs)
        whole, stages = best["whole"], best["stages"]
        sheet.rows.append(
            [
                count,
                str(best["result"]["photos"][0]),
                f"{whole['wall_s']:.1f}",
                f"{whole['cpu_s']:.1f}",
                *(f"{stages[stage]['wall_s']:.1f}" for stage in ("reconstruct", "adjust")),
                f"{whole['peak_mb']:.0f}",
            ]
        )
    found = figures["exponent"]
    met = reached(max(slope["all"] for slope in found.values()), TARGET, least=False)
    sheet.notes += [exponents_in_words(found, "n"), f"Wanted: at most n^{TARGET} of each; met: {met}."]
    return [sheet]


def _best(runs: list[dict[str, Any]]) -> dict[str, Any]:
    return min(runs, key=lambda m: m["whole"]["wall_s"])
