"""Real photos without a cube: how many are used, how well the printed markers' edges agree, how long a mesh takes."""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

from rich.console import Console

from specimap_core.photos.folder import photo_paths
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.options import RunOptions
from specimap_core.pipeline.outputs import Outputs
from specimap_core.pipeline.report_builder import triangulated_edges
from specimap_core.pipeline.settings import settings_from
from specimap_core.pipeline.stages import adjust_stage, reconstruct_stage
from specimap_core.reconstruct.dense.device import dense_device

APPLE = "real_aruco_apple"
EDGE_MM = 33.0


def bench_apple(console: Console, folder: Path) -> dict[str, object]:
    """42 phone photos of an apple on a printed board: stages 1 and 2."""
    options = RunOptions(edge_mm=EDGE_MM, dictionary="DICT_7X7_1000")
    settings = settings_from(options, dense_device(os.environ))
    workers = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as scratch:
        store, clock = Outputs(Path(scratch)).store, Clock(lambda stage, share: None, lambda: False)
        start = time.perf_counter()
        stage1 = reconstruct_stage(photo_paths(folder / "images"), settings, store, "a", clock, workers)
        stage2 = adjust_stage(stage1, settings, store, "b", clock, workers)
        seconds = time.perf_counter() - start
    edges = triangulated_edges(stage1, stage2.adjusted, EDGE_MM)
    markers, vertices = len(stage2.adjusted.marker_ids), len(stage2.mesh.vertices)
    used, given = len(stage1.reconstruction.photos), len(stage1.names) + len(stage1.refused)
    console.print(
        f"{APPLE}: {used} of {given} photos used, {markers} markers, edge {edges.mean:.3f} mm "
        f"(given {EDGE_MM}), spread {100 * edges.std / edges.mean:.2f} %, mesh of {vertices:,} vertices "
        f"in {seconds:.1f} s at {options.working_px} px",
        highlight=False,
    )
    return {
        "photos": [used, given],
        "markers": markers,
        "edge_mm": [edges.mean, edges.std],
        "rms_px": stage2.adjusted.rms_after_px,
        "seconds": seconds,
        "vertices": vertices,
    }
