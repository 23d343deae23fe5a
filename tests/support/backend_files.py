"""Stand-ins for what a user brings: folders that look like whole checkouts, and weights files."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES
from specimap_core.reconstruct.backends.mast3r.settings import NEEDED


def no_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Take away what the machine's own environment says of backends."""
    for name in set(os.environ) & set(BACKEND_VARIABLES):
        monkeypatch.delenv(name)


def bring_mast3r(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set MASt3R's variables to files that are there; gives the weights."""
    home, weights = folder / "mast3r", folder / "mast3r.pth"
    for part in NEEDED:
        (home / part).parent.mkdir(parents=True, exist_ok=True)
        (home / part).touch()
    weights.write_bytes(b"weights")
    monkeypatch.setenv("SPECIMAP_MAST3R_HOME", str(home))
    monkeypatch.setenv("SPECIMAP_MAST3R_WEIGHTS", str(weights))
    return weights


def bring_da3(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Set the variables of Depth Anything 3 to files that are there; gives the weights."""
    code, weights = folder / "da3" / "src" / "depth_anything_3" / "cfg.py", folder / "model.safetensors"
    code.parent.mkdir(parents=True)
    code.touch()
    weights.write_bytes(b"weights")
    monkeypatch.setenv("SPECIMAP_DA3_HOME", str(folder / "da3"))
    monkeypatch.setenv("SPECIMAP_DA3_WEIGHTS", str(weights))
    return weights
