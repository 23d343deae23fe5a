"""The measured process. Says on standard output when a stage begins, and at the end what came out.

Photos and a cube: a whole run. ``--run`` and a cube: stages 3 and 4. Photos alone: stages 1 and 2.
"""

from __future__ import annotations

import os
import sys
import time
from argparse import ArgumentParser, Namespace
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path

from bench.tracing import tracing
from specimap_core.cube import open_cube
from specimap_core.json_text import json_text
from specimap_core.photos.folder import photo_paths
from specimap_core.pipeline.artefacts import load_stage1, load_stage2
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.options import DEFAULTS, RunOptions
from specimap_core.pipeline.outputs import Inputs, Outputs, prepare_folder
from specimap_core.pipeline.register_stage import CubeInput, register_stage
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings, settings_from
from specimap_core.pipeline.stages import adjust_stage, reconstruct_stage, render_stage
from specimap_core.reconstruct.dense.device import dense_device
from specimap_core.register.registration import Surface
from specimap_core.report.model import Report
from specimap_core.surface.raycast import RayCaster


class _Steps:
    """Notes where one stage ends and the next begins."""

    def __init__(self) -> None:
        self._stage = "start"

    def __call__(self, stage: str, share: float) -> None:
        if stage != self._stage:
            self._stage = stage
            self.say(stage=stage)

    @staticmethod
    def say(**event: object) -> None:
        sys.stdout.write(json_text({"cpu": time.process_time(), **event}) + "\n")
        sys.stdout.flush()


def settings_of(options: Namespace) -> PipelineSettings:
    """The published settings, with the markers that the options name."""
    chosen = RunOptions(edge_mm=options.edge_mm, dictionary=options.dictionary, method=options.method)
    return settings_from(chosen, dense_device(os.environ))


def _said(report: Report) -> dict[str, object]:
    return {
        "photos": [len(report.photos.used), report.photos.given],
        "corner_2d_mm": report.corner_2d_mm.mean,
        "corner_3d_mm": report.corner_3d_mm.median,
        "edge_mm": [report.edge_length_mm.mean, report.edge_length_mm.std],
        "points": report.coverage.points,
        "seconds": report.seconds,
    }


def _run(options: Namespace, steps: _Steps) -> dict[str, object]:
    report = run_pipeline(Inputs(options.photos, options.cube), options.out, settings_of(options), progress=steps)
    return _said(report)


def _surface(options: Namespace, steps: _Steps) -> dict[str, object]:
    """Stages 1 and 2."""
    prepare_folder(options.out)
    settings, store, workers = settings_of(options), Outputs(options.out).store, os.cpu_count() or 1
    clock = Clock(steps, lambda: False)
    stage1 = reconstruct_stage(photo_paths(options.photos), settings, store, "bench", clock, workers)
    stage2 = adjust_stage(stage1, settings, store, "bench", clock, workers)
    used, given = len(stage1.reconstruction.photos), len(stage1.names) + len(stage1.refused)
    return {"photos": [used, given], "vertices": len(stage2.mesh.vertices)}


def _register(options: Namespace, steps: _Steps) -> dict[str, object]:
    """Stages 3 and 4 of a cube on the reconstruction that an earlier run left in ``options.run``."""
    store, keys = Outputs(options.run).store, {}
    for path in store.folder.glob("*.npz"):
        stage, _, keys[stage] = path.stem.partition("-")
    # Without depth maps, as in a worker's process for this stage; a run has let them go by then.
    stage1 = load_stage1(store, keys["reconstruct"], with_depth=False)
    stage2 = load_stage2(store, keys["adjust"])
    if stage1 is None or stage2 is None:
        raise RuntimeError(f"{options.run} holds no finished reconstruction")
    prepare_folder(options.out)
    clock = Clock(steps, lambda: False)
    # Opening the cube belongs to the stage; its hash is taken while stage 1 works, as a run does.
    cube = open_cube(options.cube)
    settings, outputs, caster = settings_of(options), Outputs(options.out), RayCaster(stage2.mesh)
    grids = render_stage(stage2, caster, settings, outputs.store, "bench", clock)
    surface = Surface(stage2.adjusted, stage2.sigma_mm, caster, *grids)
    return _said(register_stage(stage1, surface, CubeInput(cube, (), {}), settings, outputs, clock))


def parsed() -> Namespace:
    """The command line."""
    parser = ArgumentParser()
    parser.add_argument("--edge-mm", type=float, default=DEFAULTS.edge_mm)
    parser.add_argument("--dictionary", default=DEFAULTS.dictionary)
    parser.add_argument("--method", default=DEFAULTS.method)
    parser.add_argument("--photos", type=Path)
    parser.add_argument("--run", type=Path)
    parser.add_argument("--cube", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--steps", action="store_true", help="time the steps too; stage `start` is then all imports")
    return parser.parse_args()


def main() -> None:
    """Parse, run, say."""
    options, steps = parsed(), _Steps()
    work = _register if options.run else _run if options.cube else _surface
    with tracing() if options.steps else nullcontext() as tracer:
        if tracer is None:
            result = work(options, steps)
        else:
            steps.say(stage="opening")
            result = work(options, steps)
            result["steps"] = {name: asdict(spent) for name, spent in tracer.steps.items()}
    steps.say(stage="end", result=result)


if __name__ == "__main__":
    main()
