"""Whatever leaves the program as JSON is JSON: no NaN, no infinity, for any parser."""

from __future__ import annotations

import ast
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from specimap_cli.progress import json_listener
from specimap_core.json_text import json_log_line, json_ready, json_text
from specimap_core.pipeline.outputs import Outputs
from specimap_core.register.figures import Spread
from specimap_core.report.model import Report, read_report
from tests.support.document_scene import folder_of, full_report
from tests.support.places import ROOT
from tests.support.scenes import specimap

SOURCES = ("core", "infra", "hospital", "service", "workers", "cli", "validation", "client/src", "bench")
ELSEWHERE = {
    # These run in an interpreter without Specimap; what reads them writes strictly.
    "bench/faults/stand_in.py",
    "core/specimap_core/sandbox/child.py",
    "core/specimap_core/reconstruct/backends/probe.py",
    "core/specimap_core/json_text.py",
}


def strictly(text: str) -> Any:
    """Parse as the standard has it: Python's parser takes NaN."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


# ---- one place ----------------------------------------------------------------------------------------


def encoders(source: str) -> list[ast.Call]:
    """Calls of the standard encoder that let NaN through."""
    calls = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)]
    named = [
        c
        for c in calls
        if isinstance(c.func, ast.Attribute)
        and c.func.attr in ("dumps", "dump")
        and isinstance(c.func.value, ast.Name)
        and c.func.value.id == "json"
    ]
    return [
        c
        for c in named
        if not any(
            k.arg == "allow_nan" and isinstance(k.value, ast.Constant) and k.value.value is False for k in c.keywords
        )
    ]


def test_nothing_writes_json_but_by_the_strict_encoder() -> None:
    loose = []
    for folder in SOURCES:
        for path in sorted((ROOT / folder).rglob("*.py")):
            source, name = path.read_text("utf-8"), str(path.relative_to(ROOT))
            if name in ELSEWHERE:
                continue
            loose += [f"{name}:{call.lineno}" for call in encoders(source)]
            assert "from json import" not in source, name
    assert loose == []


def test_the_scan_sees_loose_encoders() -> None:
    assert len(encoders("import json\njson.dumps(1)\njson.dump(1, f)\njson.dumps(1, allow_nan=True)")) == 3
    assert encoders("import json\njson.dumps(1, allow_nan=False)\njson.loads('1')") == []


# ---- values -------------------------------------------------------------------------------------------

LEAVES = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
TREES = st.recursive(
    LEAVES,
    lambda one: st.lists(one, max_size=4) | st.tuples(one) | st.dictionaries(st.text(max_size=3), one, max_size=4),
)


def without_nonsense(value: Any) -> Any:
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [without_nonsense(v) for v in value]
    return {k: without_nonsense(v) for k, v in value.items()} if isinstance(value, dict) else value


@given(TREES)
def test_every_tree_is_written_and_read_back(value: Any) -> None:
    assert strictly(json_text(value)) == without_nonsense(value)
    assert strictly(json_text(value, indent=1, ensure_ascii=False)) == without_nonsense(value)


def test_numbers_of_numpy_paths_and_sets() -> None:
    given_ = {
        "f4": np.float32(0.5),
        "nan": np.float32("nan"),
        "i": np.int64(3),
        "b": np.bool_(True),
        7: Path("/a/b"),
        "array": np.array([[1.0, np.inf], [np.nan, -2.0]]),
        "set": {1},
        "double": np.float64("-inf"),
    }
    assert strictly(json_text(given_)) == {
        "f4": 0.5,
        "nan": None,
        "i": 3,
        "b": True,
        "7": "/a/b",
        "array": [[1.0, None], [None, -2.0]],
        "set": [1],
        "double": None,
    }
    assert strictly(json_text({"a\udcff": Path("b\udcff"), "c": "\udcff"})) == {r"a\udcff": r"b\udcff", "c": r"\udcff"}
    assert json_ready(Spread(mean=1, std=2, n=3)).startswith("mean=1")
    assert strictly(json_log_line({"a": float("nan")}, default=str, sort_keys=True)) == {"a": None}


# ---- a report without figures -------------------------------------------------------------------------


def nothing_known(value: Any) -> Any:
    """The report with every number that is no count unknown."""
    if isinstance(value, float):
        return float("nan")
    if isinstance(value, list):
        return [nothing_known(v) for v in value]
    return {k: nothing_known(v) for k, v in value.items()} if isinstance(value, dict) else value


@pytest.fixture
def empty() -> Report:
    report = Report.model_validate(nothing_known(full_report(10).model_dump()))
    assert np.isnan(report.corner_2d_mm.mean)
    return report


def test_a_report_without_figures_is_json_and_comes_back(empty: Report, tmp_path: Path) -> None:
    assert strictly(empty.text())["corner_2d_mm"]["mean"] is None
    assert strictly(json_text(empty.summary()))["sigma_mm"]["median"] is None
    (tmp_path / "report.json").write_text(empty.text(), "utf-8")
    back = read_report(tmp_path)
    assert np.isnan(back.corner_2d_mm.mean)
    assert np.isnan(back.reprojection_px.after)
    assert back.photos == empty.photos


def test_events_of_a_run_without_figures_are_json(
    empty: Report, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    listener = json_listener()
    listener.progress("register", 0.5)
    listener.report(empty)
    listener.finished(empty, Outputs(tmp_path))
    lines = capsys.readouterr().out.splitlines()
    assert [strictly(line)["event"] for line in lines] == ["progress", "finished", "finished"]


@pytest.mark.slow
def test_commands_on_a_folder_without_figures_print_json(empty: Report, tmp_path: Path) -> None:
    out = folder_of(tmp_path / "out", empty)
    # As a version left it that wrote what Python writes.
    (out / "report.json").write_text(json.dumps(empty.model_dump(mode="json")), "utf-8")
    answer = specimap("info", out, "--json")
    assert answer.status == 0
    assert strictly(answer.out)["corner_2d_mm"]["mean"] is None
    assert specimap("info", out).status == 0
    for format in ("csv", "npz"):
        output = specimap("export", out, "--format", format, "--json")
        assert strictly(output.out)["event"] == "exported"
    output = specimap("report", out, "--json")
    assert strictly(output.out)["event"] == "reported"
    with np.load(out / "cloud.npz") as stored:
        strictly(str(stored["attributes"]))
    strictly((out / "cloud.zarr" / "zarr.json").read_text("utf-8"))
