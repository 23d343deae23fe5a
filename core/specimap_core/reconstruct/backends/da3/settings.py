"""What the user says of Depth Anything 3 in the environment: where it is, and how it runs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from specimap_core.errors import BackendUnavailableError, SettingsError
from specimap_core.reconstruct.backends.weights import Weights, find_weights, named_path

NAME = "da3"
PREFIX = "SPECIMAP_DA3_"
VARIABLES = {
    "WEIGHTS": "Folder with model.safetensors as published for DA3-SMALL or DA3-BASE, or the file itself.",
    "WEIGHTS_SHA256": "The sha256 that the weights must have; by default any, and the report carries it.",
    "HOME": "Checkout of ByteDance-Seed/Depth-Anything-3; by default the package depth-anything-3 is used.",
    "PYTHON": "Interpreter that has its requirements; by default the one that runs Specimap.",
    "DEVICE": "auto, cpu, cuda or cuda:N; auto takes a GPU where there is one.",
    "SIZE_PX": "Longer side of the photos as the network sees them, a multiple of 14.",
    "BATCH": "Photos that the network sees at once: more agree better and take more memory.",
}
"""Name after the prefix, and what it is."""

PATCH_PX = 14
WEIGHTS_FILE = "model.safetensors"
MODULES = ("numpy", "torch", "safetensors", "einops", "omegaconf", "addict")
"""What the network's process imports besides the network itself, and what the network imports."""
SOURCE = "DA3-SMALL and DA3-BASE are published by depth-anything on Hugging Face, under Apache 2.0."


@dataclass(frozen=True)
class Da3Settings:
    """One field a variable of :data:`VARIABLES`; the size is upstream's. ``hash_cache``: a folder that keeps the sha256
    of the weights."""

    weights: Path | None = None
    weights_sha256: str | None = None
    home: Path | None = None
    python: str | None = None
    device: str = "auto"
    size_px: int = 504
    batch: int = 12
    hash_cache: Path | None = None

    @property
    def modules(self) -> tuple[str, ...]:
        """What the interpreter must be able to import."""
        return MODULES if self.home else (*MODULES, "depth_anything_3")

    def code_path(self) -> list[Path]:
        """Folders for the module path of the network's process.

        Raises:
            BackendUnavailableError: ``home`` is no checkout.
        """
        if self.home is None:
            return []
        source = self.home / "src"
        if not (source / "depth_anything_3" / "cfg.py").is_file():
            raise BackendUnavailableError(
                f"{self.home} is no checkout of Depth Anything 3: src/depth_anything_3 is not in it.",
                advice=f"Correct {PREFIX}HOME, or unset it and install the package depth-anything-3.",
                missing=str(source / "depth_anything_3"),
            )
        return [source]

    def find_weights(self) -> Weights:
        """The weights file.

        Raises:
            BackendUnavailableError: it is not named, not there, not the pinned one, or of a kind that is not read.
        """
        path = self.weights / WEIGHTS_FILE if self.weights and self.weights.is_dir() else self.weights
        if path is not None and path.suffix != ".safetensors":
            raise BackendUnavailableError(
                f"{path.name} is no .safetensors file; files that could run code when read are not taken.",
                advice=f"Name the published {WEIGHTS_FILE}, or its folder, in {PREFIX}WEIGHTS. {SOURCE}",
                missing=WEIGHTS_FILE,
            )
        return find_weights(
            "Depth Anything 3",
            f"{PREFIX}WEIGHTS",
            path,
            pin=self.weights_sha256,
            source=SOURCE,
            hash_cache=self.hash_cache,
        )


def settings_from_environment(environment: Mapping[str, str]) -> Da3Settings:
    """The settings as the variables say.

    Raises:
        SettingsError: a value cannot be; details name the variable.
    """

    def text(name: str, pattern: str, takes: str, fallback: str) -> str:
        given = environment.get(PREFIX + name, "").strip() or fallback
        if re.fullmatch(pattern, given) is None:
            raise SettingsError(f"{PREFIX}{name} is {given!r}.", advice=f"It takes {takes}.", setting=PREFIX + name)
        return given

    usual = Da3Settings()
    sizes = "|".join(str(v) for v in range(4 * PATCH_PX, 2017, PATCH_PX))
    return Da3Settings(
        weights=named_path(PREFIX + "WEIGHTS", environment),
        weights_sha256=environment.get(PREFIX + "WEIGHTS_SHA256") or None,
        home=named_path(PREFIX + "HOME", environment),
        python=environment.get(PREFIX + "PYTHON") or None,
        device=text("DEVICE", r"auto|cpu|cuda(:\d+)?", "auto, cpu, cuda or cuda:N", usual.device),
        size_px=int(text("SIZE_PX", sizes, "a multiple of 14 from 56 to 2016", str(usual.size_px))),
        batch=int(text("BATCH", r"[1-9]\d{0,2}", "a number of photos from 1 to 999", str(usual.batch))),
    )
