"""Upstream's own code, on a checkout that SPECIMAP_MAST3R_HOME names: images, checkpoints, the way to a cloud.

The published weights are not needed: an oracle stands in the network's place and answers exactly what a phantom shows.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from specimap_core.errors import BackendUnavailableError, DepthNotFoundError, PhotosNotConnectedError
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backend import ReconstructSettings
from specimap_core.reconstruct.backends.environment import backends_from
from specimap_core.reconstruct.backends.mast3r import backend
from specimap_core.reconstruct.backends.mast3r.images import plan_preparation
from specimap_core.reconstruct.backends.mast3r.settings import PREFIX
from specimap_core.sandbox.process import Answer, run_child
from specimap_core.truth.judge import judge
from tests.support.mast3r_scene import Seen, adjusted_errors_mm, see, upstream
from tests.support.places import SUPPORT
from tests.support.scenes import SMALL, OnDisk, phantom_on_disk

ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Small matrices on a crowded machine: threads that wait for each other take ten times as long as one."""


def ask(request: dict[str, object], arrays: dict[str, np.ndarray[tuple[int, ...], np.dtype[np.uint8]]]) -> Answer:
    home, python = upstream()
    return run_child(
        SUPPORT / "mast3r_loader.py",
        {"home": home, **request},
        arrays,
        name="mast3r",
        steps={"load": 1.0},
        progress=lambda share: None,
        python=python,
        environment=ONE_THREAD,
    )


def test_images_are_what_upstreams_loader_makes_of_them(tmp_path: Path) -> None:
    sizes = [(512, 512), (700, 700), (1280, 960), (600, 800), (1280, 853), (1000, 563), (333, 250)]
    paths, ours = [], {}
    for k, (width, height) in enumerate(sizes):
        image = np.random.default_rng(k).integers(0, 256, (height, width, 3), dtype=np.uint8)
        paths.append(str(tmp_path / f"{k}.png"))
        Image.fromarray(image).save(paths[-1])
        ours[f"{k}"] = plan_preparation((width, height), 512).apply(image)
    found = ask({"photos": paths}, ours).arrays
    for k in range(len(sizes)):
        assert found[f"image_{k}"].shape == ours[f"{k}"].shape
        assert np.array_equal(found[f"image_{k}"], found[f"ours_{k}"])


def test_a_checkpoint_of_upstreams_kind_is_loaded_whole_or_refused(tmp_path: Path) -> None:
    path = tmp_path / "small.pth"
    facts = ask({"checkpoint": str(path)}, {}).facts
    assert facts["same"] is True
    assert facts["training"] is False
    assert facts["tensors"] > 100
    home, python = upstream()
    request = {"home": home, "weights": f"{path}.part", "device": "cpu", "seed": 0, "threads": 1}
    with pytest.raises(BackendUnavailableError, match=r"do not fit its network.*decoder_embed"):
        run_child(
            SUPPORT / "mast3r_real.py",
            request,
            {"images": np.zeros((2, 64, 64, 3), np.uint8)},
            name="mast3r",
            steps={"load": 1.0},
            progress=lambda share: None,
            python=python,
            environment=ONE_THREAD,
        )


def test_a_network_that_knows_nothing_ends_in_an_answer_or_a_reason(tmp_path: Path) -> None:
    path = tmp_path / "small.pth"
    ask({"checkpoint": str(path)}, {})
    home, python = upstream()
    images = np.random.default_rng(0).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
    request = {
        "home": home,
        "weights": path,
        "device": "cpu",
        "seed": 0,
        "threads": 1,
        "subsample": 8,
        "schedule": (5, 5),
        "pairs": [(0, 1), (0, 2), (1, 2)],
        "names": ["a", "b", "c"],
    }
    shares: list[float] = []
    try:
        answer = run_child(
            SUPPORT / "mast3r_real.py",
            request,
            {"images": images},
            name="mast3r",
            steps=backend.STEPS,
            progress=shares.append,
            python=python,
            environment=ONE_THREAD,
        )
    except (PhotosNotConnectedError, DepthNotFoundError):
        pass
    else:
        assert answer.arrays["depth"].shape == (3, 64, 64)
        assert np.isfinite(answer.arrays["cam_to_world"]).all()
        assert shares[-1] > 0.9
    assert shares == sorted(shares)
    assert max(shares) > 0.5


def with_oracle(folder: Path, monkeypatch: pytest.MonkeyPatch, bare: int) -> tuple[OnDisk, Seen]:
    """A phantom of eight photos, and the environment that answers for it; the last ``bare`` photos show nothing."""
    home, python = upstream()
    phantom = replace(SMALL, photos=8)
    disk = phantom_on_disk(folder / "phantom", phantom)
    names = sorted(p.name for p in disk.photos.iterdir())
    for name in names[len(names) - bare :]:
        noise = np.random.default_rng(0).normal(128, 3, (phantom.photo_size, phantom.photo_size, 3))
        Image.fromarray(noise.astype(np.uint8)).save(disk.photos / name)
    seen = see(disk.photos, phantom, 128)
    weights = folder / "oracle.npz"
    sure = np.ones(seen.images.shape[:3])
    sure[len(sure) - bare :] = 0
    np.savez(weights, images=seen.images, points=seen.points, poses=seen.poses, sure=sure)
    for name, value in {"HOME": home, "WEIGHTS": weights, "SIZE_PX": 128, "CACHE": folder / "cache"}.items():
        monkeypatch.setenv(PREFIX + name, str(value))
    if python:
        monkeypatch.setenv(PREFIX + "PYTHON", python)
    monkeypatch.setenv("ORACLE", str(weights))
    for name, value in ONE_THREAD.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(backend, "CHILD", SUPPORT / "mast3r_oracle.py")
    # The oracle brings its own stand-in for torchvision.
    monkeypatch.setattr("specimap_core.reconstruct.backends.requirements.check_backend", lambda name, backends: None)
    return disk, seen


@pytest.mark.parametrize("bare", [0, 1])
def test_the_whole_way_with_exact_predictions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bare: int) -> None:
    """Photos that show nothing do not stop the rest."""
    disk, seen = with_oracle(tmp_path, monkeypatch, bare)
    out = tmp_path / "out"
    settings = PipelineSettings(reconstruct=ReconstructSettings(backend="mast3r"))
    backends = backends_from(os.environ, "mast3r")
    report = run_pipeline(Inputs(disk.photos, disk.header), out, settings, backends=backends, workers=1)
    assert report.photos.used == [p.name for p in seen.photos]
    assert {"licence_non_commercial", "backend_run"} <= {w.code for w in report.warnings}
    assert list((tmp_path / "cache").iterdir()) == []
    assert report.edge_length_mm.mean == pytest.approx(6.8, rel=5e-3)
    # A pixel of these photos is 0.2 mm, one of the network 0.6 mm, and a corner of the cube is 0.5 mm wide: exact
    # depth on so coarse a grid leaves a quarter of a millimetre. An error of zero would mean that truth leaked in.
    truth = judge(out, disk.folder)
    assert 0.02 < float(np.median(truth.errors_mm)) < 0.4
    assert 0.05 < float(np.percentile(truth.errors_mm, 90)) < 0.8
    assert truth.coverage > 0.7
    assert abs(truth.scale) < 5e-3


@pytest.mark.parametrize("bare", [0, 1])
def test_the_published_way_with_exact_predictions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, bare: int) -> None:
    """Judged before the cube: free corners of eight photos leave the cube's camera loose, with any backend."""
    disk, seen = with_oracle(tmp_path, monkeypatch, bare)
    found = backend.Mast3rBackend(backends_from(os.environ, "mast3r").mast3r).reconstruct(
        seen.photos, seen.corners, ReconstructSettings(hold_to_markers=False), workers=1, progress=lambda share: None
    )
    assert found.photos == tuple(range(8))
    assert {m.photo for m in found.maps} == set(range(8 - bare))
    apart = adjusted_errors_mm(found, seen, disk.truth, "free")
    # Upstream matches to about a pixel of the network, 0.6 mm, and its own cameras carry that.
    assert 0.02 < float(np.median(apart)) < 0.6
    assert 0.05 < float(np.percentile(apart, 90)) < 1.2
