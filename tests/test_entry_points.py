"""Entry points read the environment and set up the process; modules that are imported do neither."""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from specimap_core.threads import limit_blas_threads
from tests.support.places import ROOT

FOLDERS = ("core", "infra", "hospital", "service", "workers", "cli", "validation")
READERS = {
    "cli/specimap_cli/app.py",
    "cli/specimap_cli/demo.py",
    "cli/specimap_cli/doctor.py",
    "cli/specimap_cli/validation.py",
    "infra/specimap_infra/settings/places.py",
    "infra/specimap_infra/settings/service.py",
    "service/specimap_service/acquisitions/dependencies.py",
    "workers/specimap_workers/__main__.py",
    "workers/specimap_workers/stage_main.py",
    # Scripts of processes of their own.
    "core/specimap_core/reconstruct/backends/mast3r/child.py",
    "core/specimap_core/screening/process.py",
    # They describe this process to the ones that it starts, or set it up.
    "core/specimap_core/sandbox/environment.py",
    "core/specimap_core/sandbox/places.py",
    "core/specimap_core/threads.py",
}
"""Modules that may look at the environment."""
ENTRY_POINTS = (
    "specimap_cli",
    "specimap_workers.__main__",
    "specimap_workers.stage_main",
    "specimap_workers.export_main",
    "specimap_core.screening.__main__",
    "bench.__main__",
    "bench.service.__main__",
)
ASSEMBLED_AT_IMPORT = {
    "cli/specimap_cli/app.py",  # the command line's own commands
    "infra/specimap_infra/migrations/env.py",  # a script that Alembic runs
    "core/specimap_core/reconstruct/features/sift.py",  # undoes what importing COLMAP does to SIGTERM
}


def sources() -> list[tuple[str, ast.Module]]:
    found = [path for folder in FOLDERS for path in sorted((ROOT / folder / f"specimap_{folder}").rglob("*.py"))]
    assert len(found) > 100
    return [(str(path.relative_to(ROOT)), ast.parse(path.read_text("utf-8"))) for path in found]


def reads_environment(tree: ast.Module) -> bool:
    return any(
        isinstance(node, ast.Attribute) and node.attr in ("environ", "environb", "getenv", "putenv")
        for node in ast.walk(tree)
    )


def acts(node: ast.stmt) -> bool:
    """Whether a statement of a module does something, rather than define it."""
    if isinstance(node, ast.Expr):
        return isinstance(node.value, ast.Call)
    if isinstance(node, ast.Assign):
        return any(isinstance(target, ast.Attribute | ast.Subscript) for target in node.targets)
    if isinstance(node, ast.If):
        return "__name__" not in ast.unparse(node.test) and any(map(acts, (*node.body, *node.orelse)))
    return isinstance(node, ast.For | ast.While | ast.With | ast.Try | ast.Delete | ast.AugAssign)


def test_entry_points_alone_look_at_the_environment() -> None:
    assert {name for name, tree in sources() if reads_environment(tree)} == READERS


def test_importing_a_module_changes_nothing_global() -> None:
    assert {name for name, tree in sources() if any(map(acts, tree.body))} == ASSEMBLED_AT_IMPORT


def test_the_parser_sees_what_acts() -> None:
    for source in ("A = f()", "if TYPE_CHECKING:\n    import b", "if __name__ == '__main__':\n    main()"):
        assert not any(map(acts, ast.parse(source).body)), source
    for source in ("f()", "a.b = 1", "a['b'] = 1", "if c:\n    f()", "with a:\n    pass", "a += [1]"):
        assert any(map(acts, ast.parse(source).body)), source


LIBRARIES = """
import json, logging, os, pkgutil, importlib
os.environ.pop("OPENBLAS_NUM_THREADS", None)
import PIL.Image
most = PIL.Image.MAX_IMAGE_PIXELS
import specimap_core
for module in pkgutil.walk_packages(specimap_core.__path__, "specimap_core."):
    if not module.name.endswith((".child", "_child", "__main__")):
        importlib.import_module(module.name)
print(json.dumps([
    "OPENBLAS_NUM_THREADS" not in os.environ,
    PIL.Image.MAX_IMAGE_PIXELS == most,
    "HEIF" not in PIL.Image.OPEN,
    logging.getLogger("tifffile").level != logging.CRITICAL,
    logging.getLogger("matplotlib").level != logging.ERROR,
]))
"""


def test_libraries_are_as_they_were_after_all_of_the_core_is_imported() -> None:
    done = subprocess.run([sys.executable, "-c", LIBRARIES], capture_output=True, text=True, check=True, timeout=120)
    assert json.loads(done.stdout) == [True] * 5


@pytest.mark.parametrize("module", ENTRY_POINTS)
def test_entry_points_limit_threads_before_they_load_numpy(module: str) -> None:
    program = f"import sys, {module}; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60, cwd=ROOT
    )
    assert done.stdout.strip() == "False"
    (main,) = [
        node
        for node in ast.parse(_file_of(module).read_text("utf-8")).body
        if isinstance(node, ast.FunctionDef) and node.name == "main"
    ]
    calls = [node for node in main.body if not isinstance(node, ast.ImportFrom)]
    assert ast.unparse(calls[1]) == "limit_blas_threads()", "the first after the docstring"


def _file_of(module: str) -> Path:
    parts = module.split(".")
    top = ROOT if parts[0] == "bench" else ROOT / parts[0].removeprefix("specimap_")
    path = top.joinpath(*parts)
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def test_threads_are_as_the_users_environment_says(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "3")
    limit_blas_threads()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "3"
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    limit_blas_threads()
    assert os.environ["OPENBLAS_NUM_THREADS"] == "1"
