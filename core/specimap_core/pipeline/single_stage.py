"""Run one stage in a process of its own, on artefacts that others left: what a worker does."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from specimap_core.cube import Cube, inspect, open_cube
from specimap_core.errors import NotFoundError
from specimap_core.notices import Notices
from specimap_core.photos.folder import photo_paths
from specimap_core.pipeline.artefacts import Stage1, Stage2, load_stage1, load_stage2
from specimap_core.pipeline.clock import Clock, Progress
from specimap_core.pipeline.failures import as_stage_failure
from specimap_core.pipeline.outputs import Inputs, Outputs, prepare_folder
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backends.environment import UNCONFIGURED, BackendSettings


@dataclass(frozen=True)
class StageRun:
    """One stage of a job. ``out`` holds the artefacts of the stages before, under their ``keys``, and takes the new.

    ``keys`` are of all four stages; ``seconds`` and ``reused`` tell of the stages before, for the report; ``hashes``
    of the inputs go into the report too.
    """

    stage: str
    inputs: Inputs
    out: Path
    settings: PipelineSettings
    keys: Mapping[str, str]
    seconds: Mapping[str, float] = field(default_factory=dict)
    reused: Sequence[str] = ()
    hashes: Mapping[str, str] = field(default_factory=dict)
    workers: int = 1
    backends: BackendSettings = UNCONFIGURED


def run_stage(run: StageRun, *, progress: Progress, cancelled: Callable[[], bool] = lambda: False) -> float:
    """Run it; gives the seconds it took.

    Raises:
        NotFoundError: an artefact of a stage before is not there, or does not read.
        SpecimapError: its leaves, as the stage raises them.
    """
    run.settings.check()
    prepare_folder(run.out)
    clock = Clock(progress, cancelled, seconds=run.seconds, reused=run.reused)
    stages = {"reconstruct": _reconstruct, "adjust": _adjust, "render": _render, "register": _register}
    with as_stage_failure(run.stage):
        stages[run.stage](run, clock)
    return clock.seconds[run.stage]


def _reconstruct(run: StageRun, clock: Clock) -> None:
    from specimap_core.pipeline.stages import reconstruct_stage

    # A useless cube is refused before minutes of work.
    _warnings(_cube(run))
    store = Outputs(run.out).store
    reconstruct_stage(
        photo_paths(run.inputs.photos),
        run.settings,
        store,
        run.keys["reconstruct"],
        clock,
        run.workers,
        with_depth=False,
        backends=run.backends,
    )


def _adjust(run: StageRun, clock: Clock) -> None:
    from specimap_core.pipeline.stages import adjust_stage

    store = Outputs(run.out).store
    kept = load_stage2(store, run.keys["adjust"])
    stage1 = _stage1(run, with_depth=kept is None)
    adjust_stage(stage1, run.settings, store, run.keys["adjust"], clock, run.workers, kept)


def _render(run: StageRun, clock: Clock) -> None:
    from specimap_core.pipeline.stages import render_stage
    from specimap_core.surface.raycast import RayCaster

    stage2 = _stage2(run)
    render_stage(stage2, RayCaster(stage2.mesh), run.settings, Outputs(run.out).store, run.keys["render"], clock)


def _register(run: StageRun, clock: Clock) -> None:
    from specimap_core.pipeline.artefacts import load_grids
    from specimap_core.pipeline.register_stage import CubeInput, register_stage
    from specimap_core.pipeline.stages import render_stage
    from specimap_core.register.registration import Surface
    from specimap_core.surface.raycast import RayCaster

    outputs, cube = Outputs(run.out), _cube(run)
    stage1, stage2 = _stage1(run, with_depth=False), _stage2(run)
    caster = RayCaster(stage2.mesh)
    store, key = outputs.store, run.keys["render"]
    # Rendered again only where the grids are of another run of stage 2.
    grids = load_grids(store, key, stage2.mesh) or render_stage(stage2, caster, run.settings, store, key, clock)
    surface = Surface(stage2.adjusted, stage2.sigma_mm, caster, *grids)
    given = CubeInput(cube, _warnings(cube), {"key": run.keys["register"], **run.hashes})
    register_stage(stage1, surface, given, run.settings, outputs, clock)


def _cube(run: StageRun) -> Cube:
    return open_cube(run.inputs.cube, white=run.inputs.white, dark=run.inputs.dark)


def _warnings(cube: Cube) -> Notices:
    return cube.warnings + inspect(cube, cube.mean_image())


def _stage1(run: StageRun, *, with_depth: bool) -> Stage1:
    found = load_stage1(Outputs(run.out).store, run.keys["reconstruct"], with_depth=with_depth)
    if found is None:
        raise _absent("reconstruct")
    return found


def _stage2(run: StageRun) -> Stage2:
    found = load_stage2(Outputs(run.out).store, run.keys["adjust"])
    if found is None:
        raise _absent("adjust")
    return found


def _absent(stage: str) -> NotFoundError:
    return NotFoundError(f"The artefact of stage {stage} is not there.", advice="Run that stage again.", stage=stage)
