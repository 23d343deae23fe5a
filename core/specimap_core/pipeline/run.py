"""Run the four stages in one process: each is loaded where an earlier run left it, else called, saved and timed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from specimap_core.cube import inspect, open_cube
from specimap_core.photos.folder import photo_folder, photo_paths
from specimap_core.pipeline.artefacts import load_stage2
from specimap_core.pipeline.clock import STAGES, Clock, Progress
from specimap_core.pipeline.keys import digest_of, register_key, surface_keys
from specimap_core.pipeline.outputs import Inputs, Outputs, prepare_folder
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backends.environment import UNCONFIGURED, BackendSettings
from specimap_core.report.model import Report


def run_pipeline(
    inputs: Inputs,
    out: Path,
    settings: PipelineSettings,
    *,
    backends: BackendSettings = UNCONFIGURED,
    progress: Progress = lambda stage, share: None,
    cancelled: Callable[[], bool] = lambda: False,
    workers: int | None = None,
) -> Report:
    """Photos and cube to cloud, mesh, corners, preview and report in ``out``.

    Stages whose inputs have not changed since an earlier run into the same folder are not repeated. Raises leaves
    of SpecimapError; finished stages are kept then.
    """
    # Their imports are the slow ones.
    from specimap_core.pipeline.register_stage import CubeInput, register_stage
    from specimap_core.pipeline.stages import adjust_stage, reconstruct_stage, render_stage
    from specimap_core.register.registration import Surface
    from specimap_core.surface.raycast import RayCaster

    settings.check()
    workers = workers or os.cpu_count() or 1
    paths = photo_paths(inputs.photos)
    cube = open_cube(inputs.cube, white=inputs.white, dark=inputs.dark)
    prepare_folder(out)
    outputs, clock = Outputs(out), Clock(progress, cancelled)
    with ThreadPoolExecutor(1) as background:
        # Hashing a cube of a gigabyte takes about a second, which the reconstruction hides.
        fingerprint = background.submit(cube.fingerprint)
        # Inspecting it early refuses a useless cube before minutes of work.
        mean = cube.mean_image()
        warnings = (*cube.warnings, *inspect(cube, mean), *photo_folder(inputs.photos).warnings())
        with ThreadPoolExecutor(workers) as pool:
            digests = {p.name: d for p, d in zip(paths, pool.map(_digest, paths), strict=True)}
        keys, store = surface_keys(digests, settings, backends), outputs.store
        kept = load_stage2(store, keys["adjust"])
        stage1 = reconstruct_stage(
            paths,
            settings,
            store,
            keys["reconstruct"],
            clock,
            workers,
            with_depth=kept is None,
            backends=backends,
        )
        stage2 = adjust_stage(stage1, settings, store, keys["adjust"], clock, workers, kept)
        # A cube of a gigabyte comes next; the depth maps have done their work.
        stage1 = stage1.without_depth()
        key = register_key(keys["render"], fingerprint.result(), settings)
        done = _finished(outputs, key)
        if done is not None:
            for name in ("render", "register"):
                clock.report(name, 1.0)
            return done.model_copy(update={"reused_stages": list(STAGES)})
        caster = RayCaster(stage2.mesh)
        grids = render_stage(stage2, caster, settings, store, keys["render"], clock)
        surface = Surface(stage2.adjusted, stage2.sigma_mm, caster, *grids)
        hashes = {"key": key, "cube": fingerprint.result(), "photos": digest_of(digests)}
        return register_stage(stage1, surface, CubeInput(cube, warnings, hashes), settings, outputs, clock)


def _digest(path: Path) -> str:
    try:
        with open(path, "rb") as f:
            return hashlib.file_digest(f, "sha256").hexdigest()
    except OSError:
        return "unreadable"  # refused by name when the photos are read


def _finished(outputs: Outputs, key: str) -> Report | None:
    """The report of an earlier run with the same inputs and settings, if all its results are there."""
    results = (outputs.cloud, outputs.mesh, outputs.corners, outputs.cameras, outputs.preview)
    if not all(p.exists() for p in results):
        return None
    try:
        report = Report.model_validate_json(outputs.report.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return report if report.inputs.get("key") == key else None


__all__ = ["STAGES", "Clock", "Inputs", "Outputs", "run_pipeline"]
