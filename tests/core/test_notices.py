"""Notices: the catalogue holds every code that the source can give, and files keep them as they did."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError

from specimap_core.fiducials.observations import Observations
from specimap_core.geometry.cameras import Intrinsics, Pose
from specimap_core.notices import CATALOGUE, RETIRED, Notice
from specimap_core.pipeline.artefact_store import Store
from specimap_core.pipeline.artefacts import Stage1, load_stage1, save_stage1
from specimap_core.reconstruct.backend import CornersInPhotos, Reconstruction
from specimap_core.report.wording import GRAVE, WARNING_ADVICE
from tests.support.error_tables import table_of
from tests.support.places import ROOT


def codes_in(source: str) -> Iterator[str]:
    """Codes of the notices that a module makes: texts, or constants of that module."""
    tree = ast.parse(source)
    constants = {
        target.id: node.value
        for node in tree.body
        if isinstance(node, ast.Assign)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "Notice":
            code = node.args[0]
            while isinstance(code, ast.Name | ast.Subscript):
                code = constants[code.id] if isinstance(code, ast.Name) else code.value
            for value in code.values if isinstance(code, ast.Dict) else [code]:
                assert isinstance(value, ast.Constant), f"line {node.lineno}: the code of a notice is no constant"
                yield str(value.value)


def modules() -> list[Path]:
    return sorted((ROOT / "core" / "specimap_core").rglob("*.py"))


def test_the_catalogue_lists_the_codes_that_the_source_gives() -> None:
    given = {code for path in modules() for code in codes_in(path.read_text("utf-8"))}
    assert given | RETIRED == set(CATALOGUE)
    assert not given & RETIRED


def test_the_search_for_codes_finds_them() -> None:
    source = 'C = "b"\nD = {"x": "c", "y": "d"}\nNotice("a", "")\nNotice(C, "")\nNotice(D[k], "")\n'
    assert list(codes_in(source)) == ["a", "b", "c", "d"]
    with pytest.raises(AssertionError, match="line 1"):
        list(codes_in('Notice(f"{name}_differs", "")'))


def test_each_code_has_its_advice_and_a_line_in_the_docs() -> None:
    assert set(WARNING_ADVICE) == set(CATALOGUE) == table_of("Warnings")
    assert set(GRAVE) < set(CATALOGUE)
    for code, kind in CATALOGUE.items():
        assert len(kind.meaning) > 20, code
        assert not kind.meaning.endswith("."), code


def test_artefacts_keep_warnings_as_pairs_as_earlier_versions_did(tmp_path: Path) -> None:
    lens, pose = Intrinsics.centred(64, 48, 60.0), Pose(np.eye(3), np.zeros(3))
    seen = Observations(np.zeros(1, int), np.zeros(1, int), np.zeros((1, 4, 2)), np.ones(1))
    warnings = (Notice("features_chosen", "SIFT."), Notice("dense_on_gpu", "On a GPU."))
    stage = Stage1(
        Reconstruction((0,), lens, (pose,), (), np.zeros((1, 3), np.float32), (), warnings),
        CornersInPhotos(seen, (7,)),
        ("a.jpg",),
        (),
        None,
        (np.zeros((48, 64), np.uint8),),
    )
    store = Store(tmp_path)
    save_stage1(store, "key", stage)
    found = store.load("reconstruct", "key")
    assert found is not None
    assert found[1]["remarks"] == [["features_chosen", "SIFT."], ["dense_on_gpu", "On a GPU."]]
    loaded = load_stage1(store, "key")
    assert loaded is not None
    assert loaded.reconstruction.warnings == warnings


def test_a_report_holds_notices_and_nothing_else_in_them() -> None:
    notices = TypeAdapter(list[Notice])
    pairs = b'[{"code":"few_photos","message":"Few."}]'
    assert notices.validate_json(pairs) == [Notice("few_photos", "Few.")]
    assert notices.dump_json([Notice("few_photos", "Few.")]) == pairs
    with pytest.raises(ValidationError):
        notices.validate_json(b'[{"code":"few_photos","message":"Few.","level":"low"}]')
