"""Variables of backends and devices: who gets to see them, what they change, and what is refused before any work."""

from __future__ import annotations

import asyncio
import json
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from specimap_core.bundle_adjust.adjust import AdjustSettings
from specimap_core.errors import BackendUnavailableError, SettingsError
from specimap_core.pipeline.artefact_store import key_of
from specimap_core.pipeline.keys import surface_keys
from specimap_core.pipeline.options import Adjustment, Backend, RunOptions
from specimap_core.pipeline.settings import PipelineSettings, settings_from
from specimap_core.reconstruct.backend import ReconstructSettings
from specimap_core.reconstruct.backends.environment import BACKEND_VARIABLES, backends_from
from specimap_core.reconstruct.backends.mast3r import settings as mast3r
from specimap_core.reconstruct.backends.requirements import check_required
from specimap_core.reconstruct.dense.device import DEVICES, Device, dense_device
from specimap_core.reconstruct.dense.settings import DepthSettings
from specimap_core.reconstruct.features import choice
from specimap_core.sandbox.environment import bare_environment
from specimap_core.sandbox.process import child_environment
from specimap_workers.plan import plan_of
from specimap_workers.stage_process import StageProcess
from specimap_workers.workspaces import Workspaces
from tests.support.backend_files import bring_da3, bring_mast3r, no_variables
from tests.support.scenes import OnDisk
from tests.support.worker_scene import shop

Bring = Callable[[Path, pytest.MonkeyPatch], Path]
BACKENDS: list[tuple[Backend, Bring]] = [("mast3r", bring_mast3r), ("da3", bring_da3)]
FORMS: tuple[Adjustment, ...] = ("rigid", "free")
PHOTOS = {"a.jpg": "1" * 64}


@pytest.fixture(autouse=True)
def bare(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    no_variables(monkeypatch)
    return monkeypatch


def run_with(backend: Backend = "colmap", adjustment: Adjustment = "rigid") -> PipelineSettings:
    options = RunOptions(backend=backend, adjustment=adjustment)
    return settings_from(options, dense_device(os.environ))


def keys_of(settings: PipelineSettings) -> dict[str, str]:
    return surface_keys(PHOTOS, settings, backends_from(os.environ, settings.reconstruct.backend))


# ---- who sees them ------------------------------------------------------------------------------------

TELLS = """
import json, os, sys
folder = json.loads(sys.stdin.readline())["out"]
with open(os.path.join(folder, "seen.json"), "w") as file:
    json.dump(dict(os.environ), file)
print(json.dumps({"event": "done", "seconds": 0}), flush=True)
"""


SECRET = (
    "SPECIMAP_DATABASE_URL",
    "SPECIMAP_KEY",
    "AWS_SECRET_ACCESS_KEY",
    "PGPASSWORD",
    "DATABASE_URL",
    "S3_SECRET_KEY",
    "POSTGRES_PASSWORD",
    "GITHUB_TOKEN",
    "google_application_credentials",
    "API_KEY",
    "SENTRY_DSN",
)


@pytest.fixture
def all_set(bare: pytest.MonkeyPatch) -> None:
    for name in (*BACKEND_VARIABLES, *SECRET):
        bare.setenv(name, "value")


@pytest.mark.usefixtures("all_set")
def test_a_stages_process_sees_the_variables_of_backends_and_no_secret(tmp_path: Path) -> None:
    async def heard(stage: str, share: float) -> None:
        del stage, share

    async def run() -> None:
        workspaces = Workspaces(tmp_path, "test", "off", ())
        process = await StageProcess.start([sys.executable, "-c", TELLS], workspaces)
        await process.run({"stage": "reconstruct", "out": str(tmp_path)}, heard, 30)

    asyncio.run(run())
    seen = json.loads((tmp_path / "seen.json").read_text("utf-8"))
    assert {name for name in seen if name.startswith(("SPECIMAP_", "AWS_", "PG"))} == set(BACKEND_VARIABLES)
    assert not set(SECRET) & set(seen)
    assert seen["PATH"] == os.environ["PATH"]


@pytest.mark.usefixtures("all_set")
def test_a_networks_process_sees_none_of_them(tmp_path: Path) -> None:
    for seen in (bare_environment(), child_environment(tmp_path, {})):
        assert not [name for name in seen if name.startswith(("SPECIMAP_", "AWS_", "PG")) or name in SECRET]
        assert seen["PATH"] == os.environ["PATH"]


# ---- the device ---------------------------------------------------------------------------------------


def test_the_device_comes_from_the_environment(bare: pytest.MonkeyPatch) -> None:
    assert get_args(Device) == DEVICES
    assert run_with().reconstruct.depth.device == "auto"
    for device in DEVICES:
        bare.setenv("SPECIMAP_DENSE_DEVICE", f" {device} ")
        assert run_with().reconstruct.depth.device == device == backends_from(os.environ).device
    for device, advice in (("gpu", "Remove it: depth is measured on the CPU"), ("cuda", "one of: auto, cpu.")):
        bare.setenv("SPECIMAP_DENSE_DEVICE", device)
        for read in (run_with, lambda: backends_from(os.environ)):
            with pytest.raises(SettingsError, match=f"SPECIMAP_DENSE_DEVICE is '{device}'") as caught:
                read()
            assert caught.value.code == "setting_invalid"
            assert caught.value.details["setting"] == "SPECIMAP_DENSE_DEVICE"
            assert advice in caught.value.advice


def test_a_device_that_there_is_not_is_refused() -> None:
    for device in ("cuda", "gpu"):
        strange = ReconstructSettings(depth=DepthSettings(device=device))  # type: ignore[arg-type]
        with pytest.raises(SettingsError, match=f"no device '{device}'") as caught:
            PipelineSettings(reconstruct=strange).check()
        assert caught.value.advice == "Choose one of: auto, cpu."


# ---- what they change ---------------------------------------------------------------------------------


def test_the_default_backends_keys_know_nothing_of_other_backends(tmp_path: Path, bare: pytest.MonkeyPatch) -> None:
    settings = run_with()
    keys = keys_of(settings)
    chosen = settings.as_dict()
    assert chosen["reconstruct"]["depth"]["device"] == "auto", "a part of the keys of earlier versions"  # type: ignore[index]
    parts = {"photos": PHOTOS, "acquisition": chosen["acquisition"], "s": chosen["reconstruct"]}
    assert keys["reconstruct"] == key_of("reconstruct", parts)
    bring_mast3r(tmp_path, bare)
    bring_da3(tmp_path, bare)
    assert keys_of(run_with()) == keys
    bare.setenv("SPECIMAP_DENSE_DEVICE", "auto")
    assert keys_of(run_with()) == keys
    bare.setenv("SPECIMAP_DENSE_DEVICE", "cpu")
    assert not set(keys_of(run_with()).values()) & set(keys.values())


@pytest.mark.parametrize("backend", ["colmap", *(name for name, _ in BACKENDS)])
def test_the_adjustment_is_an_input_of_stage_1_where_that_finds_cameras_without_the_markers(
    backend: Backend, tmp_path: Path, bare: pytest.MonkeyPatch
) -> None:
    bring_mast3r(tmp_path, bare)
    bring_da3(tmp_path, bare)
    rigid, free = (keys_of(run_with(backend, form)) for form in FORMS)
    assert rigid["adjust"] != free["adjust"]
    assert (rigid["reconstruct"] == free["reconstruct"]) == (backend != "mast3r")
    assert run_with(backend, "free").for_stage1().hold_to_markers == (backend != "mast3r")
    # An edge that stage 2 alone was told counts as well.
    wide = replace(run_with(backend), adjust=AdjustSettings(edge_mm=7.0))
    assert keys_of(wide)["reconstruct"] != rigid["reconstruct"]


@pytest.mark.parametrize(("backend", "bring"), BACKENDS)
def test_settings_and_weights_of_a_network_are_inputs_of_stage_1(
    backend: Backend, bring: Bring, tmp_path: Path, bare: pytest.MonkeyPatch
) -> None:
    weights, prefix = bring(tmp_path, bare), f"SPECIMAP_{backend.upper()}_"

    def keys() -> dict[str, str]:
        return keys_of(run_with(backend))

    first = keys()
    assert first == keys()
    seen = [first]
    for name, value in (("SIZE_PX", "224"), ("DEVICE", "cpu")):
        bare.setenv(prefix + name, value)
        seen.append(keys())
    weights.write_bytes(b"other weights")
    seen.append(keys())
    # All of them differ, in every stage: what comes after stage 1 is made from it.
    assert len({key for one in seen for key in one.values()}) == 3 * len(seen)
    moved = weights.with_name(f"moved{weights.suffix}")
    weights.rename(moved)
    bare.setenv(f"{prefix}WEIGHTS", str(moved))
    bare.setenv("SPECIMAP_MAST3R_CACHE", str(tmp_path))
    assert keys() == seen[-1], "the same weights at another place, and scratch elsewhere, change no result"
    moved.unlink()
    with pytest.raises(BackendUnavailableError, match="no weights file"):
        keys()


@pytest.fixture
def job(tmp_path: Path, small: OnDisk) -> Iterator[Callable[[], dict[str, str]]]:
    """The keys of a job with MASt3R, as a worker would plan them."""
    with shop(tmp_path / "shop") as yard:
        job_id = yard.submit(yard.acquisition(small.photos, small.header), backend="mast3r")
        yield lambda: plan_of(yard.database, job_id, backends_from(os.environ)).keys


def test_a_worker_refuses_a_job_whose_backend_it_lacks(
    job: Callable[[], dict[str, str]], tmp_path: Path, bare: pytest.MonkeyPatch
) -> None:
    with pytest.raises(BackendUnavailableError, match="needs a checkout"):
        job()
    bring_mast3r(tmp_path, bare)
    first = job()
    bare.setenv("SPECIMAP_MAST3R_SUBSAMPLE", "4")
    assert not set(first.values()) & set(job().values())


# ---- what is asked for and not there ------------------------------------------------------------------


def require(settings: ReconstructSettings) -> None:
    check_required(settings, backends_from(os.environ, settings.backend))


def refused(**given: object) -> BackendUnavailableError:
    with pytest.raises(BackendUnavailableError) as caught:
        require(replace(ReconstructSettings(), **given))  # type: ignore[arg-type]
    assert caught.value.advice
    return caught.value


def test_the_default_needs_nothing_more(bare: pytest.MonkeyPatch) -> None:
    bare.setattr("specimap_core.reconstruct.backends.requirements.probe", None)  # no interpreter is asked
    require(ReconstructSettings())


def test_features_that_are_not_installed_are_refused_where_the_backend_takes_them(bare: pytest.MonkeyPatch) -> None:
    bare.setattr(choice, "aliked_missing", lambda: ["kornia"])
    for backend in ("colmap", "da3"):
        assert "ALIKED needs kornia" in refused(backend=backend, features="aliked").message
    assert "checkout" in refused(backend="mast3r", features="aliked").message


def test_a_network_is_refused_for_what_it_lacks_first(tmp_path: Path, bare: pytest.MonkeyPatch) -> None:
    assert refused(backend="mast3r").details["missing"] == "SPECIMAP_MAST3R_HOME"
    assert "weights" in refused(backend="da3").message
    bring_mast3r(tmp_path, bare)
    bare.setenv("SPECIMAP_MAST3R_PYTHON", "/nowhere/python")
    assert "The interpreter of mast3r, /nowhere/python, does not answer" in refused(backend="mast3r").message
    bare.setenv("SPECIMAP_MAST3R_PYTHON", sys.executable)
    bare.setattr(mast3r, "MODULES", ("numpy", "no_such_module"))
    error = refused(backend="mast3r")
    assert error.details["missing"] == ["no_such_module"]
    assert "ENV/bin/pip install no_such_module" in error.advice
    assert error.advice.endswith("export SPECIMAP_MAST3R_PYTHON=ENV/bin/python")
    bare.setattr(mast3r, "MODULES", ("numpy",))
    require(ReconstructSettings(backend="mast3r"))
