"""Seconds of the steps of a run: the pipeline's functions wrapped from outside, so that the product carries no hooks.

Only the thread that traces is timed, and each second counts once: a function within another one's counts as part of
that one, but for those that split it. So the steps and the rest add up to the whole.
"""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any


@dataclass(frozen=True)
class Target:
    """A function, or ``Class.method``, by the module that calls it under ``name``, and the ``step`` it belongs to.

    ``splits``: its time is taken out of the step that it runs in.
    """

    step: str
    module: str
    name: str
    splits: bool = False


_RUN, _STAGES, _FINISH = (f"specimap_core.pipeline.{name}" for name in ("run", "stages", "register_stage"))
_RECONSTRUCT = "specimap_core.reconstruct"

TARGETS = (
    Target("cube opened, inspected", _RUN, "open_cube"),
    Target("cube opened, inspected", _RUN, "inspect"),
    Target("cube opened, inspected", "specimap_core.cube.model", "Cube.mean_image"),
    Target("reading photos", _STAGES, "read_photos"),
    Target("marker detection", _STAGES, "detect_in_photos"),
    Target("marker detection", _STAGES, "corners_in_photos"),
    Target("solve", _STAGES, "correct_focal_breathing"),
    Target("solve", f"{_RECONSTRUCT}.backends.colmap", "pose_photos"),
    Target("solve", _STAGES, "adjust"),
    Target("features", f"{_RECONSTRUCT}.poses", "pose_by_resection", splits=True),
    Target("features", f"{_RECONSTRUCT}.poses", "pose_by_structure_from_motion", splits=True),
    Target("dense matching", f"{_RECONSTRUCT}.backends.colmap", "dense_depth"),
    Target("Open3D waited for", "specimap_core.surface.fusion", "open3d", splits=True),
    Target("fusion", _STAGES, "fuse"),
    Target("refinement", _STAGES, "refine_mesh"),
    Target("sigma", _STAGES, "mesh_sigma"),
    Target("artefacts saved", _STAGES, "save_stage1"),
    Target("artefacts saved", _STAGES, "save_stage2"),
    Target("artefacts saved", _STAGES, "save_grids"),
    Target("contact sheet", _STAGES, "contact_sheet"),
    Target("render", _STAGES, "render_grid"),
    Target("cube markers", "specimap_core.register.registration", "find_markers", splits=True),
    Target("registration", _FINISH, "register_cube"),
    Target("registration", _FINISH, "build_report"),
    Target("motion check", "specimap_core.register.camera_refinement", "select_camera", splits=True),
    Target("mesh written", _FINISH, "write_mesh_ply"),
    Target("cloud written", _FINISH, "write_cloud"),
    Target("preview", _FINISH, "write_preview"),
)
"""In the order of a run."""


@dataclass
class Spent:
    """What a step took: seconds, seconds of all threads meanwhile, calls."""

    wall_s: float = 0.0
    cpu_s: float = 0.0
    calls: int = 0


@dataclass
class _Open:
    """A step that runs: when it began, and what the steps within it took."""

    spent: Spent
    start: tuple[float, float]
    inner: tuple[float, float] = (0.0, 0.0)


class Tracer:
    """Adds up what the steps take on the thread that made it."""

    def __init__(self) -> None:
        self.steps: dict[str, Spent] = {}
        self._open: list[_Open] = []
        self._thread = threading.get_ident()

    def counts(self, splits: bool) -> bool:
        """Whether a call that begins now is timed."""
        return threading.get_ident() == self._thread and (splits or not self._open)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time what runs within, less the steps within it."""
        spent = self.steps.setdefault(name, Spent())
        opened = _Open(spent, (time.perf_counter(), time.process_time()))
        self._open.append(opened)
        try:
            yield
        finally:
            self._open.pop()
            whole = time.perf_counter() - opened.start[0], time.process_time() - opened.start[1]
            spent.wall_s += whole[0] - opened.inner[0]
            spent.cpu_s += whole[1] - opened.inner[1]
            spent.calls += 1
            if self._open:
                outer = self._open[-1]
                outer.inner = outer.inner[0] + whole[0], outer.inner[1] + whole[1]


@contextmanager
def tracing(targets: Sequence[Target] = TARGETS) -> Iterator[Tracer]:
    """Wrap the targets, importing their modules; afterwards all is as before.

    Raises:
        AttributeError: a target is not there: the product has changed, and the list must follow.
    """
    tracer = Tracer()
    kept: list[tuple[Any, str, Any]] = []
    try:
        for target in targets:
            owner, name = owner_of(target)
            original = getattr(owner, name)
            kept.append((owner, name, original))
            setattr(owner, name, _timed(original, target, tracer))
        yield tracer
    finally:
        for owner, name, original in reversed(kept):
            setattr(owner, name, original)


def owner_of(target: Target) -> tuple[Any, str]:
    """The module or class that holds the target, imported, and the target's name there."""
    owner: Any = importlib.import_module(target.module)
    *path, name = target.name.split(".")
    for part in path:
        owner = getattr(owner, part)
    return owner, name


def _timed(original: Callable[..., Any], target: Target, tracer: Tracer) -> Callable[..., Any]:
    @wraps(original)
    def timed(*args: Any, **kwargs: Any) -> Any:
        if not tracer.counts(target.splits):
            return original(*args, **kwargs)
        with tracer.step(target.step):
            return original(*args, **kwargs)

    return timed
