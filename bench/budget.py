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
from specimap.core.accuracy import CornersInCube
from specimap.core.acquisition import photo_paths, read_photos
from specimap.core.cube import open_cube
from specimap.core.evidence.truth import SPECIMEN
from specimap.core.geometry import Floats, Intrinsics, Pose, View, fit_similarity
from specimap.core.phantom import load_truth
from specimap.core.phantom.truth import Truth
from specimap.core.pipeline.artefacts import Stage1, Stage2
from specimap.core.pipeline.clock import Clock
from specimap.core.pipeline.finish import corners_in_cube
from specimap.core.pipeline.outputs import Outputs
from specimap.core.pipeline.settings import PipelineSettings
from specimap.core.pipeline.stages import adjust_stage, mesh_of, reconstruct_stage
from specimap.core.raycast import RayCaster
from specimap.core.reconstruct.dense import dense_depth
from specimap.core.reconstruct.depth import DepthMap, volume_over
from specimap.core.register.cube_markers import find_markers
from specimap.core.register.register import place_by_camera
from specimap.core.register.settle import settle_camera
from specimap.core.surface import Mesh


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
    scene = _Scene(folder, truth, stage1, stage2, settings)
    mesh, camera = stage2.mesh, scene.camera
    yield scene.judged("nothing", mesh, camera)
    yield scene.judged("the cube's camera", mesh, scene.true_camera)
    yield scene.scaled("the scale", mesh, camera)
    images = [p.image for p in read_photos(paths, settings.acquisition, workers=workers)[0]]
    lens, poses, corners = scene.true_photos()
    maps = dense_depth(
        [images[p] for p in stage1.reconstruction.photos], lens, poses, volume_over(corners),
        settings.reconstruct.depth, workers=workers,
    )  # fmt: skip
    redone = mesh_of(tuple(maps), list(stage1.greys), lens, poses, corners, settings, workers=workers).mesh
    yield scene.judged("the photos' cameras and corners", redone, camera)
    yield scene.judged("all cameras", redone, scene.true_camera)
    rough = replace(settings, refine=replace(settings.refine, passes=()))
    unrefined = _scaled_maps(stage1, stage2)
    adjusted = stage2.adjusted
    fused = mesh_of(
        unrefined, list(stage1.greys), adjusted.lens, adjusted.poses, adjusted.corners, rough, workers=workers
    ).mesh
    yield scene.judged("nothing, and the mesh not refined", fused, camera)
    yield scene.on_true_surface("the surface")


def _scaled_maps(stage1: Stage1, stage2: Stage2) -> tuple[DepthMap, ...]:
    factor = np.float32(stage2.adjusted.scale)
    return tuple(replace(m, depth=m.depth * factor) for m in stage1.reconstruction.maps)


class _Scene:
    """A finished run beside its truth; ``ours`` takes the truth's frame into the run's."""

    def __init__(
        self, folder: Path, truth: Truth, stage1: Stage1, stage2: Stage2, settings: PipelineSettings
    ) -> None:
        self._truth, self._stage1, self._adjusted = truth, stage1, stage2.adjusted
        cube = open_cube(next((folder / "hsi").glob("*.hdr")))
        found = find_markers(cube, settings.reconstruct.dictionary, stage2.adjusted.marker_ids)
        seen: CornersInCube = corners_in_cube(found, stage2.adjusted, cube.cols)
        caster = RayCaster(stage2.mesh)
        settled = settle_camera(seen, found, cube.rows, cube.cols, caster, stage2.adjusted.corners)
        self.camera = settled.camera.view
        ids = list(truth.marker_ids)
        self._true_corners = truth.marker_corners[[ids.index(i) for i in stage2.adjusted.marker_ids]]
        _, R, t = fit_similarity(self._true_corners.reshape(-1, 3), stage2.adjusted.corners.reshape(-1, 3))
        self.ours = Pose(R, t)
        self.true_camera = View(truth.hsi_view.intrinsics, truth.hsi_view.cam_from_world @ self.ours.inverse())

    def true_photos(self) -> tuple[Intrinsics, tuple[Pose, ...], Floats]:
        """The photos' true lens, poses and corners in the run's frame."""
        names = [Path(n).name for n in self._truth.photo_names]
        used = [names.index(self._stage1.names[p]) for p in self._stage1.reconstruction.photos]
        views = [self._truth.views[i] for i in used]
        poses = tuple(v.cam_from_world @ self.ours.inverse() for v in views)
        corners = self.ours.apply(self._true_corners.reshape(-1, 3)).reshape(-1, 4, 3)
        return views[0].intrinsics, poses, corners

    def judged(self, name: str, mesh: Mesh, view: View) -> Part:
        """The error where ``view`` casts the cube's pixels onto ``mesh``."""
        placed = place_by_camera(view, RayCaster(mesh), False)
        rows, cols = placed.pixels[:, 0], placed.pixels[:, 1]
        on_it = self._truth.hsi_class[rows, cols] == SPECIMEN
        true = self.ours.apply(self._truth.hsi_xyz[rows[on_it], cols[on_it]].astype(float))
        return _part(name, np.linalg.norm(placed.xyz[on_it] - true, axis=1))

    def scaled(self, name: str, mesh: Mesh, view: View) -> Part:
        """The error with lengths as long as the true ones."""
        size, _, _ = fit_similarity(
            self._adjusted.corners.reshape(-1, 3), self._true_corners.reshape(-1, 3), with_scale=True
        )
        pose = view.cam_from_world
        return self.judged(
            name,
            replace(mesh, vertices=(mesh.vertices * size).astype(np.float32)),
            View(view.intrinsics, Pose(pose.R, pose.t * size)),
        )

    def on_true_surface(self, name: str) -> Part:
        """The error of registration alone: pixels land on the true surface where the solved camera takes them."""
        rows, cols = np.nonzero(self._truth.hsi_class == SPECIMEN)
        true = self._truth.hsi_xyz[rows, cols].astype(float)
        miss = self.camera.project(self.ours.apply(true)) - np.stack([cols, rows], -1)
        at = np.stack([rows - miss[:, 1], cols - miss[:, 0]])
        there = np.stack(
            [map_coordinates(self._truth.hsi_xyz[..., k].astype(float), at, order=1) for k in range(3)], -1
        )
        return _part(name, np.linalg.norm(there - true, axis=1))


def _part(name: str, errors: Floats) -> Part:
    known = errors[np.isfinite(errors)]
    return Part(name, float(np.median(known)), float(np.percentile(known, 95)))
