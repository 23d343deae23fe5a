"""Run the stages: load what is there, call the stage, save, time."""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from specimap.core.acquisition import Photo, Refusal, photo_paths, read_photos
from specimap.core.adjust import adjust
from specimap.core.cube import inspect, open_cube
from specimap.core.errors import CancelledError
from specimap.core.native import preload
from specimap.core.pipeline.artefacts import (
    Stage1,
    Stage2,
    Store,
    key_of,
    load_stage1,
    load_stage2,
    save_stage1,
    save_stage2,
)
from specimap.core.pipeline.outputs import Inputs, Outputs, prepare_folder
from specimap.core.pipeline.settings import PipelineSettings
from specimap.core.reconstruct.backend import ReconstructionBackend, corners_in_photos, detect_in_photos
from specimap.core.reconstruct.depth import volume_over
from specimap.core.refine import pixel_footprint_mm, refine_mesh
from specimap.core.report import Report
from specimap.core.surface import fuse
from specimap.core.uncertainty import vertex_sigma

STAGES = ("reconstruct", "adjust", "render", "register")
VOXEL_PIXELS = 2.0
"""Edge of a fusion voxel in photo pixels on the specimen: finer ones hold noise, coarser ones lose bumps."""
Progress = Callable[[str, float], None]


class Clock:
    """Times the stages, passes progress on, and stops where a stop was asked for."""

    def __init__(self, progress: Progress, cancelled: Callable[[], bool]) -> None:
        self.seconds: dict[str, float] = {}
        self.reused: list[str] = []
        self._progress = progress
        self._cancelled = cancelled
        self._running = STAGES[0], time.perf_counter()

    def report(self, stage: str, share: float) -> None:
        """Say how far a stage is.

        Raises:
            CancelledError: a stop was asked for.
        """
        if self._cancelled():
            raise CancelledError(
                f"Stopped in stage {stage}.", advice="Run again to go on from the last finished stage.", stage=stage
            )
        self._progress(stage, min(max(share, 0.0), 1.0))

    def so_far(self) -> dict[str, float]:
        """Seconds of the finished stages and of the one that runs."""
        name, start = self._running
        return {**self.seconds, name: round(time.perf_counter() - start, 3)}

    @contextmanager
    def stage(self, name: str) -> Iterator[Callable[[float], None]]:
        """Time a stage; yields its progress function."""
        self._running = name, time.perf_counter()
        self.report(name, 0.0)
        yield lambda share: self.report(name, share)
        self.seconds = self.so_far()
        self.report(name, 1.0)


def run_pipeline(
    inputs: Inputs,
    out: Path,
    settings: PipelineSettings,
    *,
    progress: Progress = lambda stage, share: None,
    cancelled: Callable[[], bool] = lambda: False,
    workers: int | None = None,
) -> Report:
    """Photos and cube to cloud, mesh, corners, preview and report in ``out``.

    Stages whose inputs have not changed since an earlier run into the same folder are not repeated. Raises leaves
    of SpecimapError; finished stages are kept then.
    """
    from specimap.core.pipeline.finish import register_and_write  # its imports are the slow ones

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
        remarks = [*cube.warnings, *inspect(cube, mean)]
        with ThreadPoolExecutor(workers) as pool:
            digests = {p.name: d for p, d in zip(paths, pool.map(_digest, paths), strict=True)}
        key1 = key_of(
            "reconstruct",
            {"photos": digests, "acquisition": asdict(settings.acquisition), "s": asdict(settings.reconstruct),
             "edge_mm": settings.adjust.edge_mm},
        )  # fmt: skip
        key2 = key_of(
            "adjust",
            {"before": key1, "s": asdict(settings.adjust), "surface": asdict(settings.surface),
             "refine": asdict(settings.refine)},
        )  # fmt: skip
        kept = load_stage2(outputs.store, key2)
        stage1 = reconstruct_stage(paths, settings, outputs.store, key1, clock, workers, with_depth=kept is None)
        stage2 = adjust_stage(stage1, settings, outputs.store, key2, clock, workers, kept)
        # A cube of a gigabyte comes next; the depth maps have done their work.
        stage1 = stage1.without_depth()
        key4 = key_of(
            "register",
            {"before": key2, "cube": fingerprint.result(), "render": asdict(settings.render),
             "s": asdict(settings.register)},
        )  # fmt: skip
        done = _finished(outputs, key4)
        if done is not None:
            for name in ("render", "register"):
                clock.report(name, 1.0)
            return done.model_copy(update={"reused_stages": list(STAGES)})
        return register_and_write(
            stage1, stage2, cube, settings, outputs, clock, remarks,
            {"key": key4, "cube": fingerprint.result(), "photos": _together(digests)},
        )  # fmt: skip


def backend_named(name: str) -> ReconstructionBackend:
    """The backend of that name; settings have been checked."""
    from specimap.core.reconstruct.colmap import ColmapBackend

    return {"colmap": ColmapBackend}[name]()


def _digest(path: Path) -> str:
    try:
        with open(path, "rb") as f:
            return hashlib.file_digest(f, "sha256").hexdigest()
    except OSError:
        return "unreadable"  # refused by name when the photos are read


def _together(digests: dict[str, str]) -> str:
    return hashlib.sha256(json.dumps(digests, sort_keys=True).encode()).hexdigest()


def _finished(outputs: Outputs, key: str) -> Report | None:
    """The report of an earlier run with the same inputs and settings, if all its results are there."""
    if not all(p.exists() for p in (outputs.cloud, outputs.mesh, outputs.corners, outputs.preview)):
        return None
    try:
        report = Report.model_validate_json(outputs.report.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return report if report.inputs.get("key") == key else None


def reconstruct_stage(
    paths: list[Path],
    settings: PipelineSettings,
    store: Store,
    key: str,
    clock: Clock,
    workers: int,
    *,
    with_depth: bool = True,
) -> Stage1:
    """Stage 1, or what an earlier run left of it, then ``with_depth`` maps or without."""
    with clock.stage("reconstruct") as progress:
        found = load_stage1(store, key, with_depth=with_depth)
        if found is not None:
            clock.reused.append("reconstruct")
            return found
        preload()
        photos, refused = read_photos(
            paths, settings.acquisition, workers=workers, progress=lambda s: progress(0.08 * s)
        )
        detections = detect_in_photos(
            photos, settings.reconstruct.dictionary, workers=workers, progress=lambda s: progress(0.08 + 0.12 * s)
        )
        corners = corners_in_photos(photos, detections, settings.reconstruct.dictionary)
        reconstruction = backend_named(settings.reconstruct.backend).reconstruct(
            photos,
            corners,
            replace(settings.reconstruct, edge_mm=settings.adjust.edge_mm),
            workers=workers,
            progress=lambda s: progress(0.2 + 0.8 * s),
        )
        stage = Stage1(
            reconstruction, corners, tuple(p.name for p in photos), tuple(refused), _subject_mm(photos),
            tuple(photos[p].grey for p in reconstruction.photos),
        )  # fmt: skip
        save_stage1(store, key, stage)
        return stage


def _subject_mm(photos: list[Photo]) -> float | None:
    stated = [p.subject_mm for p in photos if p.subject_mm]
    return float(np.median(stated)) if stated else None


def adjust_stage(
    stage1: Stage1,
    settings: PipelineSettings,
    store: Store,
    key: str,
    clock: Clock,
    workers: int,
    kept: Stage2 | None = None,
) -> Stage2:
    """Stage 2, or ``kept``, what an earlier run left of it."""
    with clock.stage("adjust") as progress:
        if kept is not None:
            clock.reused.append("adjust")
            return kept
        r = stage1.reconstruction
        seen = stage1.corners.seen
        place = {photo: k for k, photo in enumerate(r.photos)}
        posed = seen.of(np.isin(seen.photo, r.photos))
        posed = replace(posed, photo=np.array([place[int(p)] for p in posed.photo]))
        adjusted = adjust(r.lens, r.poses, posed, stage1.corners.marker_ids, settings.adjust)
        maps = tuple(replace(m, depth=m.depth * np.float32(adjusted.scale)) for m in r.maps)
        target = volume_over(adjusted.corners).centre
        voxel_mm = settings.surface.voxel_mm or VOXEL_PIXELS * pixel_footprint_mm(
            adjusted.lens, adjusted.poses, target
        )
        fused = fuse(
            list(maps), adjusted.poses, voxel_mm, settings.surface, progress=lambda s: progress(0.05 + 0.4 * s)
        )
        mesh = refine_mesh(
            fused, list(stage1.greys), adjusted.lens, adjusted.poses, voxel_mm, settings.refine,
            workers=workers, progress=lambda s: progress(0.45 + 0.5 * s),
        )  # fmt: skip
        stage = Stage2(adjusted, mesh, vertex_sigma(mesh, maps, adjusted.poses, workers=workers).astype(float))
        save_stage2(store, key, stage)
        return stage


def all_refused(stage1: Stage1) -> list[Refusal]:
    """Photos refused while reading and while reconstructing."""
    return [*stage1.refused, *stage1.reconstruction.refused]


__all__ = ["Clock", "Inputs", "Outputs", "all_refused", "run_pipeline"]
