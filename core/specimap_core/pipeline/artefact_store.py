"""Files of finished stages, keyed by a hash of everything that went into them."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from specimap_core import __version__
from specimap_core.atomic import atomic_path, remove
from specimap_core.json_text import json_text

FORMAT = 5
"""Counts up when what a stage saves, or how a stage computes it, changes: older artefacts are then not reused."""


def key_of(stage: str, parts: Mapping[str, object]) -> str:
    """Hash of a stage's name, the program's version and what went into the stage."""
    text = json_text({"stage": stage, "version": __version__, "format": FORMAT, **parts}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


class Store:
    """Artefacts in a folder: one file a stage, with the key in its name; a new one replaces the old."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def path(self, stage: str, key: str) -> Path:
        """Where the artefact of that key lies, or would lie."""
        return self.folder / f"{stage}-{key}.npz"

    def save(self, stage: str, key: str, arrays: Mapping[str, np.ndarray[Any, Any]], meta: object) -> None:
        """Write an artefact whole or not at all, then drop older ones of the stage."""
        target = self.path(stage, key)
        with atomic_path(target) as aside, open(aside, "wb") as f:
            np.savez(f, meta=np.array(json_text(meta)), **arrays)  # type: ignore[arg-type]
        for old in self.folder.glob(f"{stage}-*.npz"):
            if old != target:
                remove(old)

    def load(self, stage: str, key: str, passed_over: tuple[str, ...] = ()) -> tuple[dict[str, Any], Any] | None:
        """Arrays and meta of an artefact; None where there is none of that key, or it does not read.

        Arrays whose names start with one of ``passed_over`` stay on the disk.
        """
        path = self.path(stage, key)
        try:
            with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
                arrays = {name: archive[name] for name in archive.files if not name.startswith(passed_over)}
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error):
            return None
        meta = json.loads(str(arrays.pop("meta")))
        return arrays, meta
