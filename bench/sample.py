"""The whole run on the sample, stage by stage, compared with what is published."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.measure import Cost, Measured, measure
from specimap_core.report.published import CORNER_2D_WORDS, CORNER_3D_WORDS, STAGE_SECONDS_WORDS

SAMPLE = Path(__file__).resolve().parent.parent / "samples"


def run_sample(out: Path) -> Measured:
    """One run from the start of a process to its end."""
    return measure(["--photos", str(SAMPLE / "rgb"), "--cube", str(SAMPLE / "hsi" / "hsi.hdr"), "--out", str(out)])


def bench_sample(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Run the sample ``repeats`` times, print the fastest run, return all of them."""
    runs = [run_sample(work / f"sample_{k}") for k in range(repeats)]
    best = min(runs, key=lambda m: m.whole.wall_s)
    table = Table(title=f"The sample (24 photos, cube 464 x 432 x 16), fastest of {repeats}", title_justify="left")
    for heading in ("stage", "wall s", "CPU s", "peak MB", "published s (A100, other specimens)"):
        table.add_column(heading, justify="left" if heading == "stage" else "right")
    for name, cost in best.stages.items():
        table.add_row(name, *_cells(cost), STAGE_SECONDS_WORDS.get(name, "-"))
    table.add_section()
    table.add_row("whole", *_cells(best.whole), "-")
    console.print(table)
    output = best.result
    console.print(
        f"2D corner error {output['corner_2d_mm']:.3f} mm (published {CORNER_2D_WORDS}), "
        f"3D {output['corner_3d_mm']:.3f} mm (published {CORNER_3D_WORDS}).\n"
        "Peak: memory of the process beyond mapped files and libraries.",
        highlight=False,
    )
    return {"runs": [m.as_dict() for m in runs]}


def _cells(cost: Cost) -> tuple[str, str, str]:
    return f"{cost.wall_s:.1f}", f"{cost.cpu_s:.1f}", f"{cost.peak_mb:.0f}"
