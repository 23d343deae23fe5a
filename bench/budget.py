"""Where the error comes from: each part of the way replaced by the truth in turn."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.ndimage import map_coordinates

from bench.sample import SAMPLE
from bench.scene import Scene, scaled_maps
from specimap_core.arrays import Floats
from specimap_core.geometry.cameras import Pose, View, fit_similarity
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import read_photos
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.outputs import Outputs
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.pipeline.stages import adjust_stage, mesh_of, reconstruct_stage
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_core.surface.fusion import Mesh
from specimap_core.surface.raycast import RayCaster
from specimap_core.truth.judge import SPECIMEN
from specimap_validation.phantom import load_truth


@dataclass(frozen=True)
class Part:
    """``median`` and ``p95`` of the error, mm, with a part of the way replaced by truth."""

    name: str
    median: float
    p95: float


def bench_budget(console: Console, work: Path, repeats: int) -> dict[str, object]:
    """The sample's and, where the test data are at hand, both phantoms' budgets; runs are seeded."""
    del repeats
    value = os.environ.get("SPECIMAP_TEST_DATA")
    cases = {"sample": SAMPLE}
    if value:
        cases = {"phantom A": Path(value) / "phantom_a", "phantom hard": Path(value) / "phantom_hard"}
    figures: dict[str, object] = {}
    for number, (name, folder) in enumerate(cases.items()):
        table = Table(title=f"{name}: error with a part replaced by truth", title_justify="left")
        for heading in ("what is true", "median mm", "p95 mm"):
            table.add_column(heading, justify="left" if heading == "what is true" else "right")
        rows = []
        for part in budget(folder, work / f"budget_{number}"):
            table.add_row(part.name, f"{part.median:.3f}", f"{part.p95:.3f}")
            rows.append([part.name, part.median, part.p95])
        console.print(table)
        figures[name] = rows
    return figures


def budget(folder: Path, scratch: Path) -> Iterator[Part]:
    """Run a phantom's ``folder`` once, then again from where each part is replaced."""
    scratch.mkdir(parents=True, exist_ok=True)
    settings, workers = PipelineSettings(), os.cpu_count() or 1
    store, clock = Outputs(scratch).store, Clock(lambda stage, share: None, lambda: False)
    truth, paths = load_truth(folder), photo_paths(folder / "rgb")
    stage1 = reconstruct_stage(paths, settings, store, "1", clock, workers)
    stage2 = adjust_stage(stage1, settings, store, "2", clock, workers)
    scene = Scene(folder, truth, stage1, stage2, settings)
    mesh, camera = stage2.mesh, scene.camera
    yield _judged(scene, "nothing", mesh, camera)
    yield _judged(scene, "the cube's camera", mesh, scene.true_camera)
    yield _scaled(scene, "the scale", mesh, camera)
    images = [p.image for p in read_photos(paths, settings.acquisition, workers=workers)[0]]
    lens, poses, corners = scene.true_photos()
    maps = dense_depth(
        [images[p] for p in stage1.reconstruction.photos],
        lens,
        poses,
        volume_over(corners, poses),
        settings.reconstruct.depth,
        workers=workers,
    )
    redone = mesh_of(tuple(maps), list(stage1.greys), lens, poses, corners, settings, workers=workers).mesh
    yield _judged(scene, "the photos' cameras and corners", redone, camera)
    yield _judged(scene, "all cameras", redone, scene.true_camera)
    rough = replace(settings, refine=replace(settings.refine, passes=()))
    unrefined = scaled_maps(stage1, stage2)
    adjusted = stage2.adjusted
    fused = mesh_of(
        unrefined, list(stage1.greys), adjusted.lens, adjusted.poses, adjusted.corners, rough, workers=workers
    ).mesh
    yield _judged(scene, "nothing, and the mesh not refined", fused, camera)
    yield _on_true_surface(scene, "the surface")


def _judged(scene: Scene, name: str, mesh: Mesh, view: View) -> Part:
    """The error where ``view`` casts the cube's pixels onto ``mesh``."""
    _, _, errors = scene.placed(RayCaster(mesh), view)
    return _part(name, errors)


def _scaled(scene: Scene, name: str, mesh: Mesh, view: View) -> Part:
    """The error with lengths as long as the true ones."""
    size, _, _ = fit_similarity(
        scene.adjusted.corners.reshape(-1, 3), scene.true_corners.reshape(-1, 3), with_scale=True
    )
    pose = view.cam_from_world
    return _judged(
        scene,
        name,
        replace(mesh, vertices=(mesh.vertices * size).astype(np.float32)),
        View(view.intrinsics, Pose(pose.R, pose.t * size)),
    )


def _on_true_surface(scene: Scene, name: str) -> Part:
    """The error of registration alone: pixels land on the true surface where the solved camera takes them."""
    truth = scene.truth
    rows, cols = np.nonzero(truth.hsi_class == SPECIMEN)
    true = truth.hsi_xyz[rows, cols].astype(float)
    miss = scene.camera.project(scene.ours.apply(true)) - np.stack([cols, rows], -1)
    at = np.stack([rows - miss[:, 1], cols - miss[:, 0]])
    there = np.stack([map_coordinates(truth.hsi_xyz[..., k].astype(float), at, order=1) for k in range(3)], -1)
    return _part(name, np.linalg.norm(there - true, axis=1))


def _part(name: str, errors: Floats) -> Part:
    known = errors[np.isfinite(errors)]
    return Part(name, float(np.median(known)), float(np.percentile(known, 95)))
