"""The ``da3`` backend from photos to a cloud with an oracle for a network, and what can be missing or fail."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from specimap_core.errors import (
    BackendFailedError,
    BackendUnavailableError,
    CancelledError,
    DepthNotFoundError,
    SettingsError,
    SpecimapError,
)
from specimap_core.pipeline import stages
from specimap_core.pipeline.outputs import Inputs
from specimap_core.pipeline.run import run_pipeline
from specimap_core.pipeline.settings import PipelineSettings
from specimap_core.reconstruct.backends import requirements
from specimap_core.reconstruct.backends.da3.backend import Da3Backend
from specimap_core.reconstruct.backends.da3.child import VARIANTS, variant_of
from specimap_core.reconstruct.backends.da3.settings import Da3Settings, settings_from_environment
from specimap_core.reconstruct.backends.environment import BackendSettings
from specimap_core.reconstruct.backends.weights import sha256_of
from specimap_core.truth.judge import judge
from tests.support.da3_oracle import FACTS, oracle, write_script
from tests.support.da3_scene import Captured, reconstruct
from tests.support.scenes import SMALL, OnDisk

pytestmark = pytest.mark.usefixtures("own_cache")

SIZE_PX = 378


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    """A file that passes for weights where nothing reads it."""
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"weights")
    return path


# ---- an oracle for a network --------------------------------------------------------------------------


@pytest.mark.slow
def test_true_depth_in_any_unit_makes_a_true_cloud(
    small: OnDisk, weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = oracle(tmp_path, SMALL, SIZE_PX, noise=0.01, lost=(3,))
    own = Da3Settings(weights=weights, size_px=SIZE_PX, batch=5)
    monkeypatch.setattr(stages, "backend_named", lambda name, backends: {"da3": Da3Backend(own, script)}[name])
    # What a real network would import is not needed.
    monkeypatch.setattr(requirements, "check_backend", lambda name, backends: None)
    settings = PipelineSettings()
    settings = replace(settings, reconstruct=replace(settings.reconstruct, backend="da3"))
    heard: list[tuple[str, float]] = []
    report = run_pipeline(
        Inputs(small.photos, small.header),
        tmp_path / "out",
        settings,
        backends=BackendSettings(da3=own),  # the run's key names the weights
        progress=lambda stage, share: heard.append((stage, share)),
    )
    found = judge(tmp_path / "out", small.folder)
    # Eleven views, each off by 1 % or 1.5 mm; drawing them to known places takes most of it off, meeting five others
    # halves the rest, and refining the mesh leaves about what it leaves of any depth.
    assert 0.02 < found.median < 0.2
    assert 0.05 < found.p95 < 1.0
    assert found.coverage > 0.97
    assert 1e-7 < abs(found.scale) < 0.003
    output = {w.code: w.message for w in report.warnings}
    assert "1 of 12" in output["depth_unaligned"]
    assert "view_003" in output["depth_unaligned"]
    assert "Apache" in output["licence_apache"]
    assert "not pinned" in output["backend_run"]
    assert sha256_of(weights) in output["backend_run"]
    shares = [share for stage, share in heard if stage == "reconstruct"]
    assert shares == sorted(shares)
    assert len(report.photos.used) == 12


@pytest.mark.slow
def test_depth_that_fits_no_marker_is_no_depth(captured: Captured, weights: Path, tmp_path: Path) -> None:
    script = write_script(
        tmp_path,
        f"""rng = np.random.default_rng(0)
return {{"depth": rng.uniform(0.5, 1.5, arrays["images"].shape[:3]).astype(np.float32)}}, {FACTS}""",
    )
    with pytest.raises(DepthNotFoundError, match="no photo") as refused:
        reconstruct(captured, Da3Settings(weights=weights, size_px=126), script)
    assert len(refused.value.details["photos"]) == 12  # type: ignore[arg-type]


# ---- what can be missing or fail ----------------------------------------------------------------------


def test_what_is_missing_is_named(weights: Path, tmp_path: Path, captured: Captured) -> None:
    cases = [
        (Da3Settings(), "none is named", "SPECIMAP_DA3_WEIGHTS"),
        (Da3Settings(weights=tmp_path / "nothing.safetensors"), "no weights file", "SPECIMAP_DA3_WEIGHTS"),
        (Da3Settings(weights=tmp_path / "model.pth"), "could run code", "model.safetensors"),
        (Da3Settings(weights=weights, weights_sha256="0" * 64), "not the pinned one", "WEIGHTS_SHA256"),
        (Da3Settings(weights=weights, home=tmp_path), "no checkout", "SPECIMAP_DA3_HOME"),
        (Da3Settings(weights=weights, python=str(tmp_path / "no-python")), "does not start", "SPECIMAP_DA3_PYTHON"),
    ]
    for settings, message, advice in cases:
        with pytest.raises(BackendUnavailableError, match=message) as refused:
            reconstruct(captured, settings)
        assert advice in refused.value.advice
    folder = Da3Settings(weights=weights.parent)
    assert folder.find_weights().path == weights


def test_weights_of_other_networks_are_refused(tmp_path: Path) -> None:
    numpy_files = pytest.importorskip("safetensors.numpy")
    name = "model.backbone.pretrained.patch_embed.proj.weight"
    for width, variant in VARIANTS.items():
        numpy_files.save_file({name: np.zeros((width, 3, 14, 14), np.float32)}, tmp_path / "w.safetensors")
        assert variant_of(tmp_path / "w.safetensors") == (variant, "model.")
        numpy_files.save_file({name[6:]: np.zeros((width, 3, 14, 14), np.float32)}, tmp_path / "w.safetensors")
        assert variant_of(tmp_path / "w.safetensors") == (variant, "")
    numpy_files.save_file({name: np.zeros((1024, 3, 14, 14), np.float32)}, tmp_path / "w.safetensors")
    with pytest.raises(BackendUnavailableError, match="width 1024"):
        variant_of(tmp_path / "w.safetensors")
    numpy_files.save_file({"x": np.zeros(3, np.float32)}, tmp_path / "w.safetensors")
    with pytest.raises(BackendUnavailableError, match="another network"):
        variant_of(tmp_path / "w.safetensors")
    (tmp_path / "w.safetensors").write_bytes(b"no weights at all")
    with pytest.raises(BackendUnavailableError, match="does not read"):
        variant_of(tmp_path / "w.safetensors")


def test_failures_of_the_network_keep_their_kind(captured: Captured, weights: Path, tmp_path: Path) -> None:
    settings = Da3Settings(weights=weights, size_px=126)
    cases: list[tuple[str, type[Exception], str]] = [
        ("raise MemoryError('17 GB')", BackendFailedError, "out of memory"),
        ("print('so it goes', flush=True); os._exit(3)", BackendFailedError, "so it goes"),
        ("import no_such_module", BackendUnavailableError, "no_such_module"),
    ]
    advice = {}
    for body, kind, message in cases:
        with pytest.raises(kind, match=message) as refused:
            reconstruct(captured, settings, write_script(tmp_path, body))
        assert isinstance(refused.value, SpecimapError)
        advice[message] = refused.value.advice
    assert "SPECIMAP_DA3_BATCH" in advice["out of memory"]


def test_a_stop_ends_the_network_at_once(captured: Captured, weights: Path, tmp_path: Path) -> None:
    mark = tmp_path / "pid"
    body = f"open({str(mark)!r}, 'w').write(str(os.getpid()))\ntime.sleep(60)"

    def stop(share: float) -> None:
        if mark.exists() and mark.read_text():
            raise CancelledError("stop")

    start = time.perf_counter()
    with pytest.raises(CancelledError):
        reconstruct(captured, Da3Settings(weights=weights, size_px=126), write_script(tmp_path, body), stop)
    assert time.perf_counter() - start < 40
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


def test_settings_come_from_the_environment(tmp_path: Path) -> None:
    assert settings_from_environment({}) == Da3Settings()
    given = {
        "WEIGHTS": str(tmp_path),
        "HOME": str(tmp_path),
        "PYTHON": "python3",
        "DEVICE": "cuda:1",
        "SIZE_PX": "1008",
        "BATCH": "30",
        "WEIGHTS_SHA256": "ab",
    }
    found = settings_from_environment({f"SPECIMAP_DA3_{k}": v for k, v in given.items()})
    assert found == Da3Settings(tmp_path.resolve(), "ab", tmp_path.resolve(), "python3", "cuda:1", 1008, 30)
    for name, value in {"SIZE_PX": "500", "BATCH": "0", "DEVICE": "tpu"}.items():
        with pytest.raises(SettingsError) as refused:
            settings_from_environment({f"SPECIMAP_DA3_{name}": value})
        assert refused.value.details["setting"] == f"SPECIMAP_DA3_{name}"
