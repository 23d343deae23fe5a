"""Imports point down, what a service needs stays light, and the documents say what the program says."""

from __future__ import annotations

import ast
import inspect
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from specimap_core import errors
from specimap_core.errors import SpecimapError
from specimap_infra import errors as infra_errors
from specimap_service import errors as service_errors
from specimap_service.http_status import HTTP_STATUS
from tests.support.places import ROOT

FOLDERS = ("core", "infra", "hospital", "service", "workers", "cli", "validation")
MAY_IMPORT = {
    "core": {"core"},
    "infra": {"core", "infra"},
    "hospital": {"core", "infra", "hospital"},
    "workers": {"core", "infra", "workers"},
    "service": {"core", "infra", "hospital", "service"},
    "cli": {"core", "infra", "hospital", "workers", "service", "validation", "cli", "client"},
    "validation": {"core", "validation"},
}
CORE_ORDER = (
    *("errors", "arrays", "notices", "threads", "progress", "json_text", "atomic", "native"),
    *("geometry", "sandbox", "photos", "fiducials", "cube"),
    *("bundle_adjust", "surface", "render", "cloud", "reconstruct", "register", "verification"),
    *("truth", "report", "export", "screening", "pipeline"),
)
"""Modules and packages of core: each imports those before it alone."""
FEATURE_IMPORTS = {
    "auth": set(),
    "clouds": {"auth"},
    "jobs": {"auth", "clouds"},  # deleting a job closes its clouds
    "acquisitions": {"auth", "jobs", "clouds"},  # deleting an acquisition removes its jobs' results
    "uploads": {"auth", "acquisitions"},  # an upload becomes a file of an acquisition
    "hospital": {"auth", "acquisitions", "clouds"},  # an order belongs to an acquisition, DICOM objects to a result
    # The description of the API.
    "contract": {"auth", "jobs", "uploads"},
}
"""Features of the service, and which others each may import."""
SHARED_IMPORTS = {
    "health": {"auth"},
    "body_limits": {"auth"},
    "space": {"auth"},
    "idempotency": {"auth"},
    "query_parameters": {"uploads"},
    "app": set(FEATURE_IMPORTS),
}
"""Modules next to the features that may import some; all others import none."""
HEAVY = ("cv2", "open3d", "pycolmap", "embreex", "scipy", "torch")
LIGHT = (
    "specimap_core.cloud",
    "specimap_core.report.model",
    "specimap_core.errors",
    "specimap_core.reconstruct.backends.environment",
    "specimap_cli.app",
    "specimap_infra.migrate",
    "specimap_infra.settings",
    "specimap_service.app",
)


def imported(source: str) -> set[str]:
    """Absolute names of all modules that a module's source imports, at its top and inside functions."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def modules(folder: str) -> list[Path]:
    found = sorted((ROOT / folder / f"specimap_{folder}").rglob("*.py"))
    assert found
    return found


@pytest.mark.parametrize("folder", FOLDERS)
def test_imports_point_down(folder: str) -> None:
    allowed = {f"specimap_{name}" for name in MAY_IMPORT[folder]}
    wrong = []
    for path in modules(folder):
        own = {name.split(".")[0] for name in imported(path.read_text("utf-8")) if name.startswith("specimap")}
        wrong += [f"{path.relative_to(ROOT)} imports {name}" for name in sorted(own - allowed)]
    assert wrong == []


def imported_features(path: Path) -> set[str]:
    names = [name.split(".") for name in imported(path.read_text("utf-8"))]
    return {name[1] for name in names if name[0] == "specimap_service" and name[1] in FEATURE_IMPORTS}


def test_features_of_the_service_import_only_the_features_they_build_on() -> None:
    service = ROOT / "service" / "specimap_service"
    assert {path.parent.name for path in service.glob("*/__init__.py")} == set(FEATURE_IMPORTS)
    for path in modules("service"):
        folder = path.relative_to(service).parts[0]
        allowed = FEATURE_IMPORTS[folder] | {folder} if path.parent != service else SHARED_IMPORTS.get(path.stem, set())
        assert imported_features(path) <= allowed, path.relative_to(service)
    assert imported_features(service / "context.py") == set()


def test_features_build_on_each_other_without_a_circle() -> None:
    # Each feature may import only those named before it.
    for number, allowed in enumerate(FEATURE_IMPORTS.values()):
        assert allowed <= set(list(FEATURE_IMPORTS)[:number])


@pytest.mark.parametrize("folder", [folder for folder in FOLDERS if folder not in ("service", "cli")])
def test_only_the_service_knows_http_statuses(folder: str) -> None:
    for path in modules(folder):
        roots = {name.split(".")[0] for name in imported(path.read_text("utf-8"))}
        assert not roots & {"fastapi", "starlette", "http"}, path.relative_to(ROOT)


def test_packages_of_core_import_those_before_them() -> None:
    wrong = []
    for path in modules("core"):
        own = path.relative_to(ROOT / "core" / "specimap_core").with_suffix("").parts[0]
        if own == "__init__":
            continue
        names = {name.split(".")[1] for name in imported(path.read_text("utf-8")) if name.startswith("specimap_core.")}
        later = set(CORE_ORDER[CORE_ORDER.index(own) + 1 :])
        wrong += [f"{path.relative_to(ROOT)} imports {name}" for name in sorted(names & later)]
        assert names - {"__version__"} <= set(CORE_ORDER)
    assert wrong == []


def test_no_module_imports_open3d() -> None:
    # `specimap_core.native` loads it by name: a missing system library is an error with advice there.
    importers = {
        path.name
        for folder in FOLDERS
        for path in modules(folder)
        if "open3d" in {name.split(".")[0] for name in imported(path.read_text("utf-8"))}
    }
    assert importers == set()


def test_no_test_module_imports_another() -> None:
    # What several need lies in tests/support: a test can be moved, split or run alone.
    wrong = [
        f"{path.relative_to(ROOT)} imports {name}"
        for path in sorted((ROOT / "tests").rglob("*.py"))
        for name in sorted(imported(path.read_text("utf-8")))
        if name.startswith("tests.") and any(part.startswith("test_") for part in name.split("."))
    ]
    assert wrong == []


def test_the_parser_of_imports_sees_them() -> None:
    source = "import a.b\nfrom specimap_core import cloud\ndef f():\n    from c.d import e\n"
    assert imported(source) == {"a.b", "specimap_core.cloud", "c.d.e"}


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_pull_nothing_heavy(module: str) -> None:
    program = f"import sys, json, {module}; print(json.dumps([m for m in {HEAVY!r} if m in sys.modules]))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert json.loads(done.stdout) == []


def test_heavy_modules_are_recognised() -> None:
    program = "import sys, specimap_core.register.cube_camera; print('cv2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60)
    assert done.stdout.strip() == "True"


# ---- documents ----------------------------------------------------------------------------------------


def leaves() -> list[type[SpecimapError]]:
    return [
        leaf
        for module in (errors, infra_errors, service_errors)
        for _, leaf in inspect.getmembers(module, inspect.isclass)
        if issubclass(leaf, SpecimapError) and leaf.__module__ == module.__name__
    ]


def test_each_error_has_its_own_code_and_a_status() -> None:
    codes = [leaf.code for leaf in leaves()]
    assert len(set(codes)) == len(codes)
    assert set(HTTP_STATUS) == set(leaves())


def test_errors_page_lists_every_code_with_its_status_and_meaning() -> None:
    page = (ROOT / "docs" / "errors.md").read_text("utf-8")
    rows = re.findall(r"^\| `(\w+)` \| (\d+) \| (.+?) \| (.+?) \|$", page, re.MULTILINE)
    listed = {code: (int(status), meaning, advice) for code, status, meaning, advice in rows}
    assert len(rows) == len(listed), "a code stands twice"
    assert set(listed) == {leaf.code for leaf in leaves()}
    for leaf in leaves():
        status, meaning, advice = listed[leaf.code]
        assert status == HTTP_STATUS[leaf]
        assert len(meaning) > 20
        assert advice.endswith(".")


def test_pages_link_to_files_that_exist() -> None:
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")), ROOT / "samples" / "README.md"]:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text("utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}"


# ---- what is installed and shipped --------------------------------------------------------------------


def test_lock_pins_what_the_project_asks_for() -> None:
    import tomllib

    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    wanted = [
        *project["dependencies"],
        *(
            requirement
            for extra in ("infra", "screening", "documents", "hospital", "service", "pipeline", "dev")
            for requirement in project["optional-dependencies"][extra]
        ),
    ]
    lines = [line for line in (ROOT / "requirements.lock").read_text("utf-8").splitlines() if line[:1] not in ("", "#")]
    pins = {canonicalize_name(pin.name): pin for pin in map(Requirement, lines)}
    assert len(pins) == len(lines)
    for text in wanted:
        requirement = Requirement(text)
        if requirement.name == "specimap":  # an extra that includes another
            continue
        (pin,) = pins[canonicalize_name(requirement.name)].specifier
        assert pin.operator == "=="
        assert requirement.specifier.contains(pin.version), text


def test_each_dependency_is_listed_once() -> None:
    import tomllib

    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    lists = [project["dependencies"], *project["optional-dependencies"].values()]
    names = [Requirement(text).name for requirements in lists for text in requirements]
    own = [name for name in names if name != "specimap"]
    assert sorted(own) == sorted(set(own))


def test_sample_is_small_and_its_truth_fits_its_cube() -> None:
    from specimap_core.cube import open_cube
    from specimap_validation.phantom import load_truth

    samples = ROOT / "samples"
    size = sum(f.stat().st_size for f in samples.rglob("*") if f.is_file())
    assert 5_000_000 < size < 12_000_000
    truth, cube = load_truth(samples), open_cube(samples / "hsi" / "hsi.hdr")
    assert truth.hsi_class.shape == (cube.rows, cube.cols)
    assert len(truth.wavelengths_nm) == cube.bands
    assert len(truth.views) == len(list((samples / "rgb").glob("*.jpg"))) == 24


def test_truth_of_the_sample_projects_onto_its_cube() -> None:
    from specimap_validation.phantom import load_truth

    truth = load_truth(ROOT / "samples")
    row, col = np.nonzero(truth.hsi_class == 1)
    miss = truth.hsi_view.project(truth.hsi_xyz[row, col].astype(float)) - np.stack([col, row], 1)
    # Truth is rounded to 1/256 mm, about 7.5 px/mm: an offset of even a tenth of a pixel is a wrong crop.
    assert float(np.abs(miss).max()) < 0.05
