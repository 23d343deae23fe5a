"""Stage 4 on full-size cubes: registered and written, against the machine's own bound."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

from rich.console import Console
from rich.table import Table

from bench.bound import bound_seconds
from bench.measure import measure
from bench.sample import SAMPLE, run_sample
from bench.synthetic import BANDS, COLS, ROWS, enlarge, write_envi_cube
from specimap_core.cloud import Cloud

KINDS = [(dtype, interleave) for dtype in ("uint16", "float32") for interleave in ("bsq", "bil", "bip")]
TARGET_S = {"uint16": 4.0, "float32": 6.0}
TARGET_MB = 600


def bench_cube(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """Register and write each kind of cube ``repeats`` times on the sample's reconstruction."""
    run = work / "sample_0"
    if not (run / "report.json").is_file():
        run_sample(run)
    cube = enlarge(SAMPLE / "hsi" / "hsi.hdr")
    table = Table(
        title=f"Stage 4, cube {COLS} x {ROWS} x {BANDS} to written cloud, fastest of {repeats}", title_justify="left"
    )
    for heading in ("cube", "GB", "wall s", "target", "CPU s", "peak MB", "target", "bound s", "share of bound"):
        table.add_column(heading, justify="right", no_wrap=True)
    figures: dict[str, object] = {}
    for dtype, interleave in KINDS:
        header, out = work / "full.hdr", work / "full_out"
        write_envi_cube(cube, header, dtype, interleave)
        raw = header.with_suffix(".raw")
        os.sync()  # the cube's own pages must not be on their way to the disk while the cloud is written
        runs = [measure(["--run", str(run), "--cube", str(header), "--out", str(out)]) for _ in range(repeats)]
        best = min((m.stages["register"] for m in runs), key=lambda cost: cost.wall_s)
        # What is stored, in the order and number of its points: what the codec gets to see in the run.
        bound = bound_seconds(raw, Cloud.open(out / "cloud.zarr").stored_spectra(slice(None)), work / "scratch")
        gigabytes = raw.stat().st_size / 1e9
        raw.unlink()
        shutil.rmtree(out)
        table.add_row(
            f"{dtype} {interleave}",
            f"{gigabytes:.2f}",
            f"{best.wall_s:.2f}",
            f"{TARGET_S[dtype]:.0f}",
            f"{best.cpu_s:.1f}",
            f"{best.peak_mb:.0f}",
            str(TARGET_MB),
            f"{bound['sum_s']:.2f}",
            f"{100 * bound['sum_s'] / best.wall_s:.0f} %",
        )
        kept = [m.as_dict() for m in runs]
        figures[f"{dtype}_{interleave}"] = {"bytes": gigabytes * 1e9, "bound": bound, "runs": kept}
    console.print(table)
    console.print("Cubes lie in the page cache. Peak: beyond mapped files. Bound: read + codec + write of the bytes.")
    return figures
