"""The client as a package: its names, its errors, and how little it pulls in."""

from __future__ import annotations

import ast
import inspect
import json
import re
import subprocess
import sys
import tomllib

import pytest

import specimap_client as sc
from specimap_client import _errors
from tests.support.job_answers import JOB
from tests.support.places import ROOT

CLIENT = ROOT / "client"
SOURCES = sorted((CLIENT / "src").rglob("*.py"))


def test_public_names() -> None:
    assert sorted(sc.__all__) == [
        "Acquisition",
        "ApiError",
        "Client",
        "Cloud",
        "Conflict",
        "ConnectionFailed",
        "Event",
        "Export",
        "ExportFailed",
        "Failure",
        "File",
        "Forbidden",
        "Job",
        "JobFailed",
        "Key",
        "Label",
        "LabelClass",
        "LogLine",
        "MissingExtra",
        "NewKey",
        "NewShare",
        "NotConfigured",
        "NotFound",
        "Point",
        "Progress",
        "Project",
        "RateLimited",
        "Refused",
        "Report",
        "Retries",
        "ServerError",
        "Share",
        "SpecimapClientError",
        "Spectra",
        "Timeout",
        "Unauthorized",
        "UnexpectedAnswer",
        "UploadFailed",
        "__version__",
    ]
    public = {path.stem for path in SOURCES if not path.stem.startswith("_")}
    assert public == {"progress"}
    named = {name for name in vars(sc) if not name.startswith("_")} - {"progress"}
    assert named == set(sc.__all__) - {"__version__"}


def test_everything_public_says_what_it_is() -> None:
    for name in sc.__all__:
        thing = getattr(sc, name)
        if not inspect.isclass(thing):
            continue
        assert inspect.getdoc(thing), name
        for member, value in vars(thing).items():
            if not member.startswith("_") and (inspect.isfunction(value) or isinstance(value, property)):
                assert inspect.getdoc(value), f"{name}.{member}"


def test_tree_of_errors_is_the_one_that_is_drawn() -> None:
    drawn: dict[str, str] = {}
    above: list[str] = []
    for line in (_errors.__doc__ or "").splitlines():
        found = re.match(r"    ((?:│   |    |├── |└── )*)(\w+)", line)
        if found:
            depth = len(found[1]) // 4
            del above[depth:]
            if above:
                drawn[found[2]] = above[-1]
            above.append(found[2])
    classes = dict(inspect.getmembers(_errors, inspect.isclass))
    real = {
        name: leaf.__bases__[0].__name__ for name, leaf in classes.items() if issubclass(leaf, sc.SpecimapClientError)
    }
    del real["SpecimapClientError"]
    assert drawn == real
    assert set(drawn) <= set(sc.__all__)


@pytest.mark.slow
def test_import_pulls_no_more_than_httpx_and_numpy_and_is_quick() -> None:
    program = """
import sys, time, json
import httpx, numpy
before, start = set(sys.modules), time.process_time()
import specimap_client
seconds = time.process_time() - start
new = {name.split(".")[0] for name in set(sys.modules) - before}
print(json.dumps([seconds, sorted(new - set(sys.stdlib_module_names))]))
"""
    runs = [
        json.loads(subprocess.run([sys.executable, "-c", program], capture_output=True, check=True, timeout=60).stdout)
        for _ in range(3)
    ]
    assert all(set(new) == {"numpy", "specimap_client"} for _, new in runs)
    assert min(seconds for seconds, _ in runs) < 0.3


def test_extras_are_asked_for_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("zarr", "xarray", "rich.progress"):
        monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "specimap_client._zarr", raising=False)
    monkeypatch.delitem(sys.modules, "specimap_client.progress", raising=False)
    summary = {
        "id": "c",
        "job_id": "j",
        "acquisition_id": "a",
        "points": 1,
        "bands": 1,
        "size": 1,
        "created_at": "2026-11-22T06:00:00Z",
    }
    with sc.Client("https://specimap.test", "spk_x") as client:
        cloud = sc.Cloud(client._session, summary)
        for use in (cloud.zarr, cloud.xarray, lambda: cloud.xyz):
            with pytest.raises(sc.MissingExtra, match=r"pip install 'specimap-client\[(zarr|xarray)\]'"):
                use()
    with pytest.raises(sc.MissingExtra, match="progress"):
        __import__("specimap_client.progress")


def test_client_knows_nothing_of_the_service() -> None:
    for path in SOURCES:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] == "specimap" for name in names), path


def test_distribution_says_the_same_as_the_package() -> None:
    project = tomllib.loads((CLIENT / "pyproject.toml").read_text("utf-8"))["project"]
    assert project["version"] == sc.__version__
    assert [re.split(r"[<>=]", requirement)[0] for requirement in project["dependencies"]] == ["httpx", "numpy"]
    assert (CLIENT / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert (CLIENT / "src" / "specimap_client" / "py.typed").exists()


def test_bars_follow_files_and_jobs(capsys: pytest.CaptureFixture[str]) -> None:
    from specimap_client.progress import file_bar, job_bar

    with file_bar() as bars:
        bars.files(sc.Progress("a.jpg", 5, 10, 5, 20))
        bars.files(sc.Progress("b.jpg", 10, 10, 20, 20))
    with job_bar() as bars:
        bars.job(sc.Job.of(JOB | {"state": "running", "stage": "render", "progress": 0.25}))
    shown = capsys.readouterr().out
    assert "b.jpg" in shown
    assert "20/20 bytes" in shown
    assert "render" in shown
