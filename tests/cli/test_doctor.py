"""``specimap doctor``: what is there is told, what is missing comes with what to do, and the status says the rest."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from specimap_cli.doctor import doctor
from specimap_core.reconstruct.backends import doctor as availability
from specimap_core.reconstruct.backends.doctor import Diagnosis, Machine, Missing, Usable
from specimap_core.reconstruct.backends.mast3r.settings import NEEDED
from specimap_core.reconstruct.backends.probe import driver_gpus, probe

app = typer.Typer()
app.command()(doctor)


def ask(*arguments: str) -> tuple[int, str]:
    result = CliRunner().invoke(app, list(arguments))
    assert "Traceback" not in result.output
    return result.exit_code, result.stdout


def part_of(answer: dict[str, Any], name: str) -> dict[str, Any]:
    (found,) = [p for p in answer["parts"] if p["name"] == name]
    return dict(found)


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """No variable of a backend is set."""
    for name in [n for n in os.environ if n.startswith(("SPECIMAP_MAST3R_", "SPECIMAP_DA3_", "SPECIMAP_DENSE_"))]:
        monkeypatch.delenv(name)
    return monkeypatch


# ---- on this machine ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_what_is_there_and_what_is_missing(bare: pytest.MonkeyPatch) -> None:
    status, out = ask("--json")
    (line,) = out.splitlines()
    answer = json.loads(line)
    assert status == 0
    assert answer["event"] == "diagnosed"
    assert answer["usable"] is True
    assert answer["machine"]["cpus"] >= 1
    assert answer["machine"]["memory_bytes"] > 2**28
    assert part_of(answer, "colmap")["usable"] is True
    assert part_of(answer, "sift")["usable"] is True
    assert "open3d" in part_of(answer, "colmap")["facts"]["modules"]
    mast3r = part_of(answer, "mast3r")
    assert mast3r["usable"] is False
    output = [m["what"] + m["do"] for m in mast3r["missing"]]
    assert any("SPECIMAP_MAST3R_HOME" in s for s in output)
    assert any("SPECIMAP_MAST3R_WEIGHTS" in s for s in output)
    assert "non-commercial" in mast3r["licence"]
    assert part_of(answer, "da3")["usable"] is False
    assert any("SPECIMAP_DA3_WEIGHTS" in m["do"] for m in part_of(answer, "da3")["missing"])


@pytest.mark.slow
def test_checkout_weights_and_interpreter_are_looked_at(tmp_path: Path, bare: pytest.MonkeyPatch) -> None:
    for needed in NEEDED:
        (tmp_path / needed).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / needed).touch()
    weights = tmp_path / "w.pth"
    weights.write_bytes(b"weights")
    digest = hashlib.sha256(b"weights").hexdigest()
    values = {"HOME": tmp_path, "WEIGHTS": weights, "WEIGHTS_SHA256": digest, "PYTHON": sys.executable}
    for name, value in values.items():
        bare.setenv(f"SPECIMAP_MAST3R_{name}", str(value))
    found = part_of(json.loads(ask("--json")[1]), "mast3r")
    assert found["facts"]["checkout"] == str(tmp_path)
    assert found["facts"]["weights"] == {"path": str(weights), "bytes": 7, "sha256": digest, "pinned": True}
    assert not [m for m in found["missing"] if "_HOME" in m["do"] or "_WEIGHTS" in m["do"]]
    assert "scipy" in found["facts"]["modules"]
    bare.setenv("SPECIMAP_MAST3R_WEIGHTS_SHA256", "0" * 64)
    bare.setenv("SPECIMAP_MAST3R_PYTHON", "/nowhere/python")
    output = [m["what"] for m in part_of(json.loads(ask("--json")[1]), "mast3r")["missing"]]
    assert any("not the pinned one" in s for s in output)
    assert any("/nowhere/python" in s for s in output)


@pytest.mark.slow
def test_a_setting_that_does_not_read_is_told(bare: pytest.MonkeyPatch) -> None:
    bare.setenv("SPECIMAP_MAST3R_GRAPH", "all")
    status, out = ask()
    assert status == 0
    assert "SPECIMAP_MAST3R_GRAPH is 'all'" in out
    assert "It takes auto, complete or swin-K." in out


@pytest.mark.parametrize(
    ("device", "advice"), [("gpu", "Remove it: depth is measured on the CPU"), ("cuda", "auto, cpu")]
)
def test_a_device_that_runs_are_refused_for_is_told_of_the_default_backend_alone(
    device: str, advice: str, bare: pytest.MonkeyPatch
) -> None:
    bare.setattr(availability, "probe", lambda python, modules: {"modules": {}})
    bare.setenv("SPECIMAP_DENSE_DEVICE", "cpu")
    assert ask("--json")[0] == 0
    bare.setenv("SPECIMAP_DENSE_DEVICE", device)
    status, out = ask("--json")
    assert status == 1
    colmap = part_of(json.loads(out), "colmap")
    assert [m["what"] for m in colmap["missing"]] == [f"SPECIMAP_DENSE_DEVICE is '{device}'."]
    assert advice in colmap["missing"][0]["do"]
    assert out.count("SPECIMAP_DENSE_DEVICE") == 1


def test_an_interpreter_tells_what_it_imports() -> None:
    found = probe(sys.executable, ("numpy", "json", "no_such_module"))
    assert found["modules"]["numpy"]
    assert found["modules"]["json"] == ""
    assert found["missing"] == {"no_such_module": "not installed"}
    assert "failed" in probe("/bin/false", ("numpy",))
    assert "failed" in probe("/nowhere/python", ("numpy",))


def test_one_command_brings_all_missing_modules(bare: pytest.MonkeyPatch) -> None:
    reasons = {"safetensors": "not installed", "torch": "libgomp.so.1 is absent", "einops": "not installed"}
    bare.setattr(availability, "probe", lambda python, modules: {"modules": {}, "missing": reasons})
    found = next(p for p in availability.diagnose(os.environ).parts if p.name == "da3")
    (missing,) = [m for m in found.missing if "pip install" in m.do]
    assert missing.what == "safetensors, einops: not installed; torch: libgomp.so.1 is absent"
    assert "pip install safetensors einops torch;" in missing.do


@pytest.mark.slow
def test_the_default_backends_libraries_answer_soon() -> None:
    started = time.process_time()
    began = time.monotonic()
    assert "failed" not in probe(sys.executable, availability.COLMAP_MODULES)
    # Two seconds alone; a crowded machine takes several times as long, and a hang a minute.
    assert time.monotonic() - began < 30
    assert time.process_time() - started < 1


# ---- other machines -----------------------------------------------------------------------------------

GPU = {"name": "Some [GPU]", "memory_bytes": 24 * 1024**3, "driver": "1"}


def diagnosis(*, usable: bool, gpus: tuple[dict[str, Any], ...] = (), torch_gpus: int | None = None) -> Diagnosis:
    missing = () if usable else (Missing("open3d: no [lib]", "Install it."),)
    weights = {"path": "w", "bytes": 3 * 1024**3, "sha256": "ab" * 32, "pinned": False}
    return Diagnosis(
        Machine(4, 8 * 1024**3, gpus, torch_gpus),
        (
            Usable("colmap", "backend", usable, "BSD", {"modules": {"pycolmap": "4.0"}}, missing),
            Usable("mast3r", "backend", True, "CC", {"modules": {"torch": "2.9"}, "weights": weights}),
        ),
    )


def test_a_default_backend_that_is_unusable_gives_status_1(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(availability, "diagnose", lambda environment: diagnosis(usable=False))
    status, out = ask()
    assert status == 1
    assert "colmap: open3d: no [lib]" in out
    assert "Install it." in out
    assert ask("--json")[0] == 1


def test_gpus_and_weights_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(availability, "diagnose", lambda environment: diagnosis(usable=True, gpus=(GPU,), torch_gpus=1))
    monkeypatch.setenv("COLUMNS", "200")
    status, out = ask()
    assert status == 0
    assert "GPU Some [GPU], 24 GiB" in out
    assert "torch reaches 1 of them. The default backend has no use for a GPU" in out
    assert "142 s on an H100" in out
    assert "weights of 3.00 GiB, sha256 abababababab, not pinned" in out


def test_the_drivers_answer_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho 'NVIDIA A100, PCIe, 40960, 570.1'\necho 'T4, 15360, 570.1'\n", "utf-8")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    first, second = driver_gpus()
    assert first == {"name": "NVIDIA A100, PCIe", "memory_bytes": 40960 * 1024**2, "driver": "570.1"}
    assert second["name"] == "T4"
    program.write_text("#!/bin/sh\necho failed\nexit 9\n", "utf-8")
    assert driver_gpus() == ()
    monkeypatch.setenv("PATH", "/nowhere")
    assert driver_gpus() == ()
