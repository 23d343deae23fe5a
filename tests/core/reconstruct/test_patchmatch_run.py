"""Depth by COLMAP's PatchMatch: chosen, run, stopped and trusted; a script answers in COLMAP's place without a GPU."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from specimap_core.arrays import Floats
from specimap_core.errors import BackendFailedError, BackendUnavailableError, CancelledError
from specimap_core.geometry.depth_map import DepthMap
from specimap_core.notices import Notices
from specimap_core.photos.folder import photo_paths
from specimap_core.photos.reading import AcquisitionSettings, read_photos
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.dense import patchmatch
from specimap_core.reconstruct.dense.multi_view import dense_depth
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.dense.volume import volume_over
from specimap_core.truth.judge import judge
from specimap_validation.phantom import Phantom
from tests.support.scenes import SMALL, OnDisk
from tests.support.true_depth import true_depth


class Scene:
    """The small phantom as PatchMatch would see it."""

    def __init__(self, small: OnDisk) -> None:
        self.phantom = Phantom(SMALL)
        self.photos = read_photos(photo_paths(small.photos), AcquisitionSettings())[0]
        self.images = [p.image for p in self.photos]
        self.lens = small.truth.views[0].intrinsics
        self.poses = tuple(v.cam_from_world for v in small.truth.views)
        self.volume = volume_over(small.truth.marker_corners)
        self.exact = np.stack([true_depth(self.phantom.scene, v) for v in small.truth.views])

    def off_mm(self, depth_map: DepthMap) -> Floats:
        """How far the map's known depths lie from the truth, mm."""
        lens, plain = depth_map.intrinsics, patchmatch.pinhole(self.lens)
        left, top = round(plain.cx - lens.cx), round(plain.cy - lens.cy)
        true = self.exact[depth_map.photo, top : top + lens.height, left : left + lens.width]
        known = depth_map.depth > 0
        return np.asarray(np.abs(depth_map.depth - true)[known], float)


@pytest.fixture(scope="module")
def scene(small: OnDisk) -> Scene:
    return Scene(small)


@pytest.mark.slow
def test_maps_lie_on_the_surface_and_false_depth_is_not_trusted(scene: Scene) -> None:
    rng = np.random.default_rng(0)
    noisy = scene.exact * (1 + 0.001 * rng.standard_normal(scene.exact.shape)).astype(np.float32)
    false = rng.random(scene.exact.shape) < 0.05
    # 4 % of 150 mm: inside the volume, far outside the tolerance.
    noisy[false] *= 0.96
    maps = patchmatch.maps_of(
        noisy, np.stack(scene.images), patchmatch.pinhole(scene.lens), scene.poses, scene.volume, workers=2
    )
    assert [m.photo for m in maps] == list(range(len(scene.poses)))
    trusted, doubted = [], []
    for m in maps:
        points = m.points(scene.poses[m.photo])
        assert (points >= scene.volume.low - 1e-3).all()
        assert (points <= scene.volume.high + 1e-3).all()
        sure = m.confidence[m.depth > 0] > 200
        trusted.append(scene.off_mm(m)[sure])
        doubted.append(scene.off_mm(m)[~sure])
        assert not m.confidence[m.depth == 0].any()
    # 0.1 % of 150 mm is 0.15 mm, whose median is 0.67 of that.
    assert 0.05 < np.median(np.concatenate(trusted)) < 0.15
    assert (np.concatenate(trusted) > 3).mean() < 0.2 * (np.concatenate(doubted) > 3).mean()


# ---- choosing, running, stopping ----------------------------------------------------------------------


def call(scene: Scene, device: str, **more: object) -> tuple[list[DepthMap], Notices]:
    settings = replace(DepthSettings(), device=device)  # type: ignore[arg-type]
    return patchmatch.measure_depth(
        scene.images,
        scene.lens,
        scene.poses,
        scene.volume,
        settings,
        **{"workers": 2, "progress": lambda share: None, **more},  # type: ignore[arg-type]
    )


@pytest.mark.slow
def test_without_cuda_a_gpu_is_refused_and_auto_takes_the_cpu(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pycolmap, "has_cuda", False)
    with pytest.raises(BackendUnavailableError, match="without CUDA") as refused:
        call(scene, "gpu")
    assert "pycolmap-cuda12" in refused.value.advice
    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(patchmatch, "cuda_devices", lambda: 0)
    with pytest.raises(BackendUnavailableError, match="No CUDA device"):
        call(scene, "gpu")
    maps, warnings = call(scene, "auto")
    assert warnings == ()
    usual = dense_depth(scene.images, scene.lens, scene.poses, scene.volume, DepthSettings(), workers=2)
    assert len(maps) == len(usual) > len(scene.poses)


def child(folder: Path, body: str) -> Path:
    """A script that answers in COLMAP's place."""
    script = folder / "child.py"
    script.write_text(f"import os, time\nimport numpy as np\n\ndef run(request, arrays, step):\n    {body}\n")
    return script


def on_gpu(scene: Scene, monkeypatch: pytest.MonkeyPatch, script: Path) -> None:
    """As if a GPU were there, and ``script`` COLMAP."""
    monkeypatch.setattr(pycolmap, "has_cuda", True)
    monkeypatch.setattr(patchmatch, "cuda_devices", lambda: 1)
    whole = patchmatch.patchmatch_depth
    monkeypatch.setattr(patchmatch, "patchmatch_depth", lambda *a, **k: whole(*a, **k, child=script))


def test_a_gpu_in_sight_is_taken_and_said(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "depth.npy", scene.exact)
    on_gpu(
        scene,
        monkeypatch,
        child(
            tmp_path,
            f"""
    step("depth", 0.5)
    assert arrays["images"].shape[:3] == {scene.exact.shape}
    return {{"depth": np.load({str(tmp_path / "depth.npy")!r})}}, {{}}""",
        ),
    )
    heard: list[float] = []
    maps, warnings = call(scene, "auto", progress=heard.append)
    assert [w.code for w in warnings] == ["dense_on_gpu"]
    assert heard == sorted(heard)
    assert heard[-1] == 1.0
    assert max(scene.off_mm(m).max() for m in maps) < 1e-3


def test_where_the_gpu_fails_auto_goes_on_with_the_cpu(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    on_gpu(scene, monkeypatch, child(tmp_path, "print('CUDA error: out of memory', flush=True); os._exit(1)"))
    with pytest.raises(BackendFailedError, match="out of memory"):
        call(scene, "gpu")
    maps, warnings = call(scene, "auto")
    assert [w.code for w in warnings] == ["dense_gpu_failed"]
    assert maps


def test_a_stop_ends_colmap_at_once(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mark = tmp_path / "pid"
    on_gpu(scene, monkeypatch, child(tmp_path, f"open({str(mark)!r}, 'w').write(str(os.getpid())); time.sleep(60)"))

    def stop(share: float) -> None:
        if mark.exists() and mark.read_text():
            raise CancelledError("stop")

    start = time.perf_counter()
    with pytest.raises(CancelledError):
        call(scene, "gpu", progress=stop)
    assert time.perf_counter() - start < 30
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_the_real_child_says_that_colmap_lacks_cuda(scene: Scene) -> None:
    if patchmatch.what_is_missing() is None:
        pytest.skip("PatchMatch can run here")
    with pytest.raises(BackendFailedError, match="CUDA"):
        patchmatch.patchmatch_depth(scene.images, scene.lens, scene.poses, scene.volume, DepthSettings(), workers=2)


def test_depth_on_a_gpu_makes_as_true_a_cloud(data_dir: Path, tmp_path: Path) -> None:
    missing = patchmatch.what_is_missing()
    if missing is not None:
        pytest.skip(missing)
    folder = data_dir / "phantom_a"
    settings = PipelineSettings()
    gpu = replace(settings.reconstruct, depth=replace(settings.reconstruct.depth, device="gpu"))
    report = run_pipeline(
        Inputs(folder / "rgb", folder / "hsi" / "hsi.hdr"), tmp_path / "out", replace(settings, reconstruct=gpu)
    )
    assert "dense_on_gpu" in [w.code for w in report.warnings]
    # The bounds of the CPU's depth on the same photos.
    found = judge(tmp_path / "out", folder)
    assert 0.01 < found.median < 0.12
    assert 0.05 < found.p95 < 0.5
    assert found.coverage > 0.97
