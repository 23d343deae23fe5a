"""The command line with the base dependencies alone, as ``pip install specimap`` leaves it."""

from __future__ import annotations

import importlib.metadata
import json
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.support.scenes import Finished

BARE = """
import sys
from importlib.machinery import PathFinder

ABSENT = set(sys.argv.pop(1).split(","))
found = PathFinder.find_spec
PathFinder.find_spec = lambda name, path=None, target=None: (
    None if name.partition(".")[0] in ABSENT else found(name, path, target)
)
from specimap_cli import main
main()
"""


def installed_by(requirements: list[str]) -> set[str]:
    """Canonical names of distributions and of all that they need."""
    found: set[str] = set()
    open_names = [(r.name, r.extras) for r in map(Requirement, requirements)]
    while open_names:
        name, extras = open_names.pop()
        if name.lower() in found:
            continue
        try:
            needed = importlib.metadata.requires(name) or []
        except importlib.metadata.PackageNotFoundError:  # for another system
            continue
        found.add(name.lower())
        for requirement in map(Requirement, needed):
            contexts = [{"extra": extra} for extra in (*extras, "")]
            if requirement.marker is None or any(requirement.marker.evaluate(c) for c in contexts):
                open_names.append((requirement.name, requirement.extras))
    return found


@pytest.fixture(scope="module")
def absent() -> str:
    """Top-level modules that the base set does not bring, as a list with commas."""
    base = [r for r in importlib.metadata.requires("specimap") or [] if "extra" not in r]
    names = {name.replace("_", "-") for name in installed_by(base)} | {"specimap"}
    modules = importlib.metadata.packages_distributions()
    missing = {
        module
        for module, distributions in modules.items()
        if not {name.lower().replace("_", "-") for name in distributions} & names
    }
    assert {"cv2", "sqlalchemy", "matplotlib", "fastapi"} <= missing
    assert not {"numpy", "zarr", "typer"} & missing
    return ",".join(sorted(missing - set(sys.stdlib_module_names)))


def bare(absent: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", BARE, absent, *arguments], capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.slow
def test_results_are_read_and_exported(absent: str, finished: Finished, tmp_path: Path) -> None:
    assert bare(absent, "--version").returncode == 0
    assert bare(absent, "info", str(finished.out)).returncode == 0
    for name in ("ply", "npz", "csv"):
        target = tmp_path / f"cloud.{name}"
        done = bare(absent, "export", str(finished.out), "--format", name, "--target", str(target), "--json")
        assert done.returncode == 0, done.stderr
        assert target.stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "extra"),
    [
        (["run", "--photos", ".", "--cube", "x.hdr", "--out", "out"], "specimap[pipeline]"),
        (["validate", "--out", "out"], "specimap[pipeline]"),
        (["serve"], "specimap[service,workers]"),
        (["worker"], "specimap[service,workers]"),
        (["keys", "list"], "specimap[service]"),
    ],
)
def test_other_commands_name_the_extra_that_is_missing(absent: str, command: list[str], extra: str) -> None:
    done = bare(absent, *command)
    assert done.returncode == 2
    assert "not installed" in done.stderr
    assert extra in done.stderr
    assert "Traceback" not in done.stderr


def test_the_refusal_names_the_module_to_a_program(absent: str) -> None:
    done = bare(absent, "run", "--photos", ".", "--cube", "x.hdr", "--out", "out", "--json")
    events = [json.loads(line) for line in done.stdout.splitlines()]
    assert events[-1]["code"] == "backend_unavailable"
    assert events[-1]["details"]["module"]
