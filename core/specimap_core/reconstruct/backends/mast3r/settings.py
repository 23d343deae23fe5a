"""What the user says of MASt3R in the environment: where it is, and how it runs."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from specimap_core.errors import BackendUnavailableError, SettingsError
from specimap_core.reconstruct.backends.weights import Weights, find_weights, named_path

NAME = "mast3r"
PREFIX = "SPECIMAP_MAST3R_"
VARIABLES = {
    "HOME": "Checkout of naver/mast3r with its submodules dust3r and croco.",
    "WEIGHTS": "The checkpoint, MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth.",
    "WEIGHTS_SHA256": "The sha256 that the checkpoint must have; by default any, and the report carries it.",
    "PYTHON": "Interpreter that has MASt3R's requirements; by default the one that runs Specimap.",
    "DEVICE": "auto, cpu, cuda or cuda:N; auto takes a GPU where there is one.",
    "GRAPH": "complete, swin-K (K next photos, in a circle) or auto: complete up to 30 photos, then swin-10.",
    "SIZE_PX": "Longer side of the photos as the network sees them, a multiple of 16.",
    "SUBSAMPLE": "Grid step of the matches, network pixels: 8, or 4 for more matches and memory.",
    "SCHEDULE": "Coarse and fine iterations of the alignment.",
    "CONFIDENCE": "Depth of less confidence is dropped; the network's own measure, from 1.",
    "CACHE": "Folder for the pairs' predictions while a job runs: 3.2 GB for 20 photos, complete graph.",
}
"""Name after the prefix, and what it is."""

NEEDED = ("mast3r/cloud_opt/sparse_ga.py", "dust3r/dust3r/model.py", "dust3r/croco/models/croco.py")
"""Files that tell a whole checkout: of upstream itself and of its two submodules."""
SOURCE = "docs/backends.md says where it comes from and under which licence."
MODULES = (
    "numpy",
    "torch",
    "torchvision",
    "roma",
    "scipy",
    "cv2",
    "PIL",
    "einops",
    "huggingface_hub",
    "trimesh",
    "tqdm",
)
"""What upstream's alignment imports."""

MANY_PHOTOS = 30
WINDOW = 10

T = TypeVar("T")


@dataclass(frozen=True)
class Mast3rSettings:
    """One field a variable of :data:`VARIABLES`; the defaults are upstream's. ``hash_cache``: a folder that keeps the
    sha256 of the weights."""

    home: Path | None = None
    weights: Path | None = None
    weights_sha256: str | None = None
    python: str | None = None
    device: str = "auto"
    graph: str = "auto"
    size_px: int = 512
    subsample: int = 8
    schedule: tuple[int, int] = (300, 300)
    confidence: float = 1.5
    cache: Path | None = None
    hash_cache: Path | None = None

    @property
    def modules(self) -> tuple[str, ...]:
        """What the interpreter must be able to import."""
        return MODULES

    def pairs(self, count: int) -> list[tuple[int, int]]:
        """Pairs of photos that the network compares, lower index first."""
        kind = self.graph
        if kind == "auto":
            kind = "complete" if count <= MANY_PHOTOS else f"swin-{WINDOW}"
        window = count if kind == "complete" else int(kind.split("-")[1])
        return sorted(
            {
                (min(i, j % count), max(i, j % count))
                for i in range(count)
                for j in range(i + 1, i + window + 1)
                if i != j % count
            }
        )


def settings_from_environment(environment: Mapping[str, str]) -> Mast3rSettings:
    """The settings as the variables say.

    Raises:
        SettingsError: a value cannot be; details name the variable.
    """

    def read(name: str, fallback: T, parse: Callable[[str], T], fits: Callable[[T], bool], takes: str) -> T:
        text = environment.get(PREFIX + name, "").strip()
        if not text:
            return fallback
        try:
            value = parse(text)
        except ValueError:
            value = None
        if value is None or not fits(value):
            raise SettingsError(f"{PREFIX}{name} is {text!r}.", advice=f"It takes {takes}.", setting=PREFIX + name)
        return value

    d = Mast3rSettings()
    return Mast3rSettings(
        home=named_path(PREFIX + "HOME", environment),
        weights=named_path(PREFIX + "WEIGHTS", environment),
        weights_sha256=environment.get(PREFIX + "WEIGHTS_SHA256") or None,
        python=environment.get(PREFIX + "PYTHON") or None,
        device=read("DEVICE", d.device, str, _matches(r"auto|cpu|cuda(:\d+)?"), "auto, cpu, cuda or cuda:N"),
        graph=read("GRAPH", d.graph, str, _matches(r"auto|complete|swin-[1-9]\d{0,2}"), "auto, complete or swin-K"),
        size_px=read(
            "SIZE_PX", d.size_px, int, lambda v: 64 <= v <= 2048 and v % 16 == 0, "a multiple of 16, 64 to 2048"
        ),
        subsample=read("SUBSAMPLE", d.subsample, int, lambda v: v in (2, 4, 8, 16), "2, 4, 8 or 16"),
        schedule=read(
            "SCHEDULE",
            d.schedule,
            _schedule,
            lambda v: 0 < v[0] <= 10000 and 0 <= v[1] <= 10000,
            "two numbers of iterations, such as 300,300",
        ),
        confidence=read("CONFIDENCE", d.confidence, float, lambda v: 1 <= v < 100, "a number from 1 to 100"),
        cache=named_path(PREFIX + "CACHE", environment),
    )


def _matches(pattern: str) -> Callable[[str], bool]:
    return lambda text: re.fullmatch(pattern, text) is not None


def _schedule(text: str) -> tuple[int, int]:
    coarse, fine = text.split(",")
    return int(coarse), int(fine)


def check_home(home: Path | None) -> Path:
    """The checkout, if it is whole.

    Raises:
        BackendUnavailableError: none is named, or a part is missing; the message says which.
    """
    if home is None:
        raise BackendUnavailableError(
            "The backend mast3r needs a checkout of MASt3R, and none is named.",
            advice=f"Set {PREFIX}HOME to one. {SOURCE}",
            missing=f"{PREFIX}HOME",
        )
    missing = [part for part in NEEDED if not (home / part).is_file()]
    if missing:
        raise BackendUnavailableError(
            f"{home} is not a whole checkout of MASt3R: {missing[0]} is missing.",
            advice=f"In the checkout run `git submodule update --init --recursive`, or correct {PREFIX}HOME.",
            missing=missing,
        )
    return home


def weights_of(settings: Mast3rSettings) -> Weights:
    """The checkpoint that the settings name; raises as :func:`find_weights` does."""
    return find_weights(
        NAME,
        f"{PREFIX}WEIGHTS",
        settings.weights,
        pin=settings.weights_sha256,
        source=SOURCE,
        hash_cache=settings.hash_cache,
    )
