"""Bounds of a run's steps: what the libraries' own work alone takes, on the same data and as many threads.

The library calls that a run makes are recorded (stages 1 and 2 up to refinement), then made again with nothing around
them. Said as JSON on standard output: seconds of wall and CPU time, by step.
"""

from __future__ import annotations

import itertools
import os
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from PIL import Image

from bench.bound import bound_seconds
from bench.child import parsed, settings_of
from specimap_core.cloud import Cloud
from specimap_core.cube import open_cube
from specimap_core.json_text import json_text
from specimap_core.native import open3d
from specimap_core.photos.folder import photo_paths
from specimap_core.pipeline import stages
from specimap_core.pipeline.clock import Clock
from specimap_core.pipeline.outputs import Outputs, prepare_folder
from specimap_core.surface.fusion import BLOCK_VOXELS, FIRST_BLOCKS, fuse
from specimap_core.surface.refinement import refine_mesh

TRIES = 3
EVERY = 16
"""One in so many look-ups of refinement is kept: all would take gigabytes."""
THREADS = os.cpu_count() or 1

BOUNDS = {
    "start-up": "the libraries' own imports, by `python -X importtime`",
    "reading photos": "decoding by Pillow, at the size that the run decodes",
    "marker detection": "OpenCV's detectMarkers on the same images",
    "dense matching": "StereoSGBM's compute on the same rectified pairs",
    "fusion": "Open3D's integrate of the same maps, their blocks known",
    "refinement": f"OpenCV's remap of the same samples, scaled up from one call in {EVERY}",
    "artefacts saved": "writing their bytes",
    "cloud written": "reading the cube's bytes, the codec, writing what it gives",
}
"""What the bound of a step is."""


class Recorder:
    """Stands in for a library's object, and keeps the calls of one method."""

    def __init__(self, real: Any, method: str, calls: list[Callable[[], object]]) -> None:
        self._real, self._method, self._calls = real, method, calls

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._real, name)
        if name != self._method:
            return value

        def call(*args: Any) -> Any:
            self._calls.append(lambda: value(*args))
            return value(*args)

        return call


class _RefinedError(Exception):
    """Ends stage 2 once the mesh is refined."""


@dataclass
class Recorded:
    """The library calls of stages 1 and 2: markers looked for, pairs matched, some of the look-ups of refinement and
    how many samples these and all of them have; and what fusion was given."""

    detections: list[Callable[[], object]] = field(default_factory=list)
    pairs: list[Callable[[], object]] = field(default_factory=list)
    lookups: list[Callable[[], object]] = field(default_factory=list)
    samples: list[tuple[int, bool]] = field(default_factory=list)
    fusion: tuple[Any, ...] = ()

    @property
    def scale(self) -> float:
        """All samples of refinement over those of the calls kept."""
        return sum(n for n, _ in self.samples) / max(sum(n for n, kept in self.samples if kept), 1)


def record(options: Namespace) -> Recorded:
    """Run stages 1 and 2 up to refinement, in a folder that is gone afterwards."""
    found, number = Recorded(), itertools.count()
    detector, matcher, remap = cv2.aruco.ArucoDetector, cv2.StereoSGBM, cv2.remap

    def fusing(*args: Any, **kwargs: Any) -> Any:
        found.fusion = args
        return fuse(*args, **kwargs)

    def look_up(*args: Any, **kwargs: Any) -> Any:
        kept = next(number) % EVERY == 0
        found.samples.append((args[1].size, kept))
        if kept:
            found.lookups.append(lambda: remap(*args, **kwargs))
        return remap(*args, **kwargs)

    def refining(*args: Any, **kwargs: Any) -> None:
        with patch.object(cv2, "remap", look_up):
            refine_mesh(*args, **kwargs)
        raise _RefinedError

    with (
        tempfile.TemporaryDirectory() as scratch,
        patch.object(
            cv2.aruco, "ArucoDetector", lambda *given: Recorder(detector(*given), "detectMarkers", found.detections)
        ),
        patch.object(
            cv2,
            "StereoSGBM",
            SimpleNamespace(create=lambda **given: Recorder(matcher.create(**given), "compute", found.pairs)),
        ),
        patch.object(stages, "fuse", fusing),
        patch.object(stages, "refine_mesh", refining),
        suppress(_RefinedError),
    ):
        prepare_folder(Path(scratch))
        settings, store = settings_of(options), Outputs(Path(scratch)).store
        clock = Clock(lambda stage, share: None, lambda: False)
        stage1 = stages.reconstruct_stage(photo_paths(options.photos), settings, store, "r", clock, THREADS)
        stages.adjust_stage(stage1, settings, store, "a", clock, THREADS)
    return found


Bound = dict[str, float]
"""``wall_s``, and ``cpu_s`` of all threads, which other work on the machine changes far less."""


def fastest(work: Callable[[], object]) -> Bound:
    """What the fastest of some tries took."""
    return _least(_spent(work) for _ in range(TRIES))


def _least(tries: Iterable[Bound]) -> Bound:
    return min(tries, key=lambda bound: bound["wall_s"])


def _spent(work: Callable[[], object]) -> Bound:
    start = time.perf_counter(), time.process_time()
    work()
    return {"wall_s": time.perf_counter() - start[0], "cpu_s": time.process_time() - start[1]}


def on_threads(calls: Iterable[Callable[[], object]]) -> None:
    """Make all calls, on as many threads as the machine has cores; what one raises is raised."""
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in pool.map(lambda call: call(), calls):
            pass


def decoding(paths: list[Path], working_px: int) -> Bound:
    """Decoding the photos, as large as the run wants them."""

    def decode(path: Path) -> None:
        with Image.open(path) as image:
            image.draft("RGB", (working_px, working_px))
            image.load()

    def all_of_them() -> None:
        with ThreadPoolExecutor(THREADS) as pool:
            list(pool.map(decode, paths))

    return fastest(all_of_them)


def integration(fusion: tuple[Any, ...]) -> Bound:
    """Integrating the maps into an empty grid; Open3D spreads each over the cores itself."""
    maps, poses, voxel_mm, settings = fusion
    o3d = open3d()
    core = o3d.core
    tries: list[Bound] = []
    for _ in range(TRIES):
        grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1,), (1,), (3,)),
            voxel_mm,
            BLOCK_VOXELS,
            FIRST_BLOCKS,
            core.Device("CPU:0"),
        )
        spent = {"wall_s": 0.0, "cpu_s": 0.0}
        for one in maps:
            view = one.view(poses[one.photo])
            depth = o3d.t.geometry.Image(np.ascontiguousarray(one.depth))
            colour = o3d.t.geometry.Image(one.colour.astype(np.float32) / 255)
            K, T = core.Tensor(view.intrinsics.matrix), core.Tensor(view.cam_from_world.matrix)
            far = float(one.depth.max()) + 1.0
            blocks = grid.compute_unique_block_coordinates(depth, K, T, 1.0, far, settings.truncation_voxels)
            given = blocks, depth, colour, K, K, T, 1.0, far, settings.truncation_voxels
            start = time.perf_counter(), time.process_time()
            grid.integrate(*given)
            spent["wall_s"] += time.perf_counter() - start[0]
            spent["cpu_s"] += time.process_time() - start[1]
        tries.append(spent)
    return _least(tries)


def writing(paths: list[Path], scratch: Path) -> Bound:
    """Writing the bytes of the files into one."""
    contents = [path.read_bytes() for path in paths]

    def write() -> None:
        with open(scratch, "wb") as f:
            for content in contents:
                f.write(content)

    bound = fastest(write)
    scratch.unlink()
    return bound


def main() -> None:
    """``--out`` is the folder that a run of the same photos and cube has filled."""
    options = parsed()
    settings, outputs = settings_of(options), Outputs(options.out)
    found = {"reading photos": decoding(photo_paths(options.photos), settings.acquisition.working_px)}
    recorded = record(options)
    if recorded.detections:
        found["marker detection"] = fastest(lambda: on_threads(recorded.detections))
    if recorded.pairs:
        found["dense matching"] = fastest(lambda: on_threads(recorded.pairs))
    if recorded.fusion:
        found["fusion"] = integration(recorded.fusion)
    if recorded.lookups:
        part = fastest(lambda: on_threads(recorded.lookups))
        found["refinement"] = {name: recorded.scale * seconds for name, seconds in part.items()}
    scratch = options.out / "scratch"
    found["artefacts saved"] = writing(sorted(outputs.store.folder.glob("*.npz")), scratch)
    if options.cube:
        stored = Cloud.open(outputs.cloud).stored_spectra(slice(None))
        (raw,) = (p for p in open_cube(options.cube).files if p != options.cube)
        found["cloud written"] = fastest(lambda: bound_seconds(raw, stored, scratch))
    sys.stdout.write(json_text(found) + "\n")


if __name__ == "__main__":
    main()
