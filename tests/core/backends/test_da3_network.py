"""Depth Anything 3's real network with random weights: it loads, answers, and says what it lacks."""

from __future__ import annotations

import importlib.util
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from specimap_core.errors import (
    BackendUnavailableError,
    DepthNotFoundError,
)
from specimap_core.geometry.cameras import look_at
from specimap_core.reconstruct.backends.da3.backend import CHILD
from specimap_core.reconstruct.backends.da3.prepare import conditioning
from specimap_core.reconstruct.backends.da3.settings import Da3Settings
from specimap_core.sandbox.process import run_child
from tests.support.da3_oracle import random_weights
from tests.support.da3_scene import Captured, reconstruct

pytestmark = pytest.mark.usefixtures("own_cache")

HOME = "SPECIMAP_DA3_HOME"


@pytest.fixture(scope="session")
def checkout() -> Path:
    """Upstream's code, with what it imports."""
    value = os.environ.get(HOME)
    if not value:
        pytest.skip(f"{HOME} names no checkout of Depth Anything 3")
    for module in ("torch", "safetensors", "einops", "omegaconf", "addict"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed")
    return Path(value)


@pytest.fixture(scope="session")
def random_network(checkout: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return random_weights(tmp_path_factory.mktemp("weights"), checkout)


# ---- the real network, random weights -----------------------------------------------------------------


def test_the_real_network_loads_and_answers(checkout: Path, random_network: Path) -> None:
    eyes = [np.array([60.0, 0, 120]), np.array([50.0, 40, 120]), np.array([0.0, 70, 110])]
    poses = conditioning([look_at(eye, np.zeros(3), np.array([0.0, 0, 1])) for eye in eyes])
    K = np.repeat(np.array([[[70.0, 0, 34.5], [0, 70, 27.5], [0, 0, 1]]]), 3, 0)
    images = np.random.default_rng(0).integers(0, 256, (3, 56, 70, 3), dtype=np.uint8)
    request = {"weights": str(random_network / "model.safetensors"), "device": "cpu", "workers": 2}
    heard: list[float] = []

    def ask(together: list[list[int]], given: object) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
        answer = run_child(
            CHILD,
            {**request, "windows": together},
            {"images": images, "K": K, "poses": np.asarray(given)},
            name="da3",
            steps={"depth": 1.0},
            progress=heard.append,
            extra_path=[checkout / "src"],
        )
        assert answer.facts["variant"] == "da3-small"
        assert answer.facts["device"] == "cpu"
        return answer.arrays["depth"]

    depth = ask([[0, 2, 1]], poses)
    assert depth.shape == (3, 56, 70)
    assert np.isfinite(depth).all()
    assert (depth > 0).all()
    assert heard[-1] == 1.0
    # Order within a window belongs to the photos, not to the depth's place; poses and company do count.
    assert np.allclose(ask([[0, 2, 1]], poses), depth, rtol=1e-5)
    assert np.abs(ask([[0], [1], [2]], poses) - depth).max() > 1e-5
    assert np.abs(ask([[0, 2, 1]], poses[[0, 0, 0]]) - depth).max() > 1e-5


def test_random_weights_give_no_surface_and_foreign_ones_do_not_load(
    checkout: Path, random_network: Path, captured: Captured, tmp_path: Path
) -> None:
    settings = Da3Settings(weights=random_network, home=checkout, size_px=126, batch=6)
    with pytest.raises(DepthNotFoundError):
        reconstruct(captured, settings)
    numpy_files = pytest.importorskip("safetensors.numpy")
    tensors = numpy_files.load_file(random_network / "model.safetensors")
    some = {k: v for k, v in tensors.items() if "head." not in k}
    numpy_files.save_file(some, tmp_path / "part.safetensors")
    with pytest.raises(BackendUnavailableError, match="lack"):
        reconstruct(captured, replace(settings, weights=tmp_path / "part.safetensors"))
    key = next(k for k in tensors if k.endswith("pos_embed"))
    numpy_files.save_file({**tensors, key: tensors[key][:, :5]}, tmp_path / "shape.safetensors")
    with pytest.raises(BackendUnavailableError, match="do not fit"):
        reconstruct(captured, replace(settings, weights=tmp_path / "shape.safetensors"))


def test_without_the_package_its_absence_is_said(random_network: Path, captured: Captured) -> None:
    if importlib.util.find_spec("depth_anything_3") is not None:
        pytest.skip("depth-anything-3 is installed")
    with pytest.raises(BackendUnavailableError, match="depth_anything_3") as refused:
        reconstruct(captured, Da3Settings(weights=random_network, size_px=126, python=sys.executable))
    assert "SPECIMAP_DA3_PYTHON" in refused.value.advice
