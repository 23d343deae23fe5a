"""How time grows with the number of photos of one specimen."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from bench.measure import measure
from specimap.core.phantom import PhantomSettings, write_phantom

COUNTS = (24, 48, 96)
TARGET = 1.3


def bench_photos(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Whole runs on 24, 48 and 96 photos of a phantom; the exponent of wall and CPU time."""
    source = work / "phantom"
    write_phantom(PhantomSettings(photos=max(COUNTS), bands=4), source)
    photos = sorted((source / "rgb").iterdir())
    table = Table(title=f"Time by number of photos, fastest of {repeats}", title_justify="left")
    for heading in ("photos", "used", "wall s", "CPU s", "reconstruct s", "bundle-adjust s", "peak MB"):
        table.add_column(heading, justify="right")
    figures: dict[str, object] = {}
    wall, cpu = [], []
    for count in COUNTS:
        folder = work / f"photos_{count}"
        folder.mkdir(exist_ok=True)
        for photo in photos[:: max(COUNTS) // count]:
            shutil.copyfile(photo, folder / photo.name)
        runs = [
            measure(["--photos", str(folder), "--cube", str(source / "hsi" / "hsi.hdr"), "--out", f"{folder}_{k}"])
            for k in range(repeats)
        ]
        best = min(runs, key=lambda m: m.whole.wall_s)
        wall.append(best.whole.wall_s)
        cpu.append(best.whole.cpu_s)
        table.add_row(
            str(count), str(best.result["photos"][0]), f"{best.whole.wall_s:.1f}", f"{best.whole.cpu_s:.1f}",
            *(f"{best.stages[s].wall_s:.1f}" for s in ("reconstruct", "adjust")), f"{best.whole.peak_mb:.0f}",
        )  # fmt: skip
        figures[str(count)] = [m.as_dict() for m in runs]
    exponents = {name: _exponent(times) for name, times in (("wall", wall), ("cpu", cpu))}
    console.print(table)
    console.print(
        f"Time grows as n^{exponents['wall']:.2f} (wall), n^{exponents['cpu']:.2f} (CPU); target: at most n^{TARGET}.",
        highlight=False,
    )
    return {"runs": figures, "exponent": exponents}


def _exponent(seconds: list[float]) -> float:
    return float(np.polyfit(np.log(COUNTS), np.log(seconds), 1)[0])
