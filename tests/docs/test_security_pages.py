"""The pages for security officers: the tests and modules that they name exist, and nothing is left out."""

from __future__ import annotations

import ast
import re
from functools import cache
from pathlib import Path

import pytest

from specimap_core import __version__
from tests.support.places import DOCS, ROOT

PAGES = sorted((DOCS / "security").glob("*.md"))
TEST = re.compile(r"`(tests/[\w/]+\.py)::(\w+)`")
SECTIONS = (
    *("DOC", "MPII", "ALOF", "AUDT", "AUTH", "CSUP", "CNFS", "DIDT", "DTBK", "EMRG", "IGAU", "MLDP", "NAUT", "CONN"),
    *("PAUT", "PLOK", "RDMP", "SBoM", "SAHD", "SGUD", "STCF", "TXCF", "TXIG", "RMOT", "OTHR"),
)
"""Of the form MDS2, 2019."""
RESEARCH = re.compile(r"(?i)research use only.{0,30}not a medical device", re.DOTALL)


@cache
def functions_of(path: Path) -> frozenset[str]:
    return frozenset(
        node.name
        for node in ast.parse(path.read_text("utf-8")).body
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.name.startswith("test_")
    )


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_test_that_a_page_names_exists(page: Path) -> None:
    missing = [
        f"{path}::{name}"
        for path, name in TEST.findall(page.read_text("utf-8"))
        if not (ROOT / path).exists() or name not in functions_of(ROOT / path)
    ]
    assert missing == []


def test_a_test_that_does_not_exist_is_seen() -> None:
    assert TEST.findall("`tests/a/test_b.py::test_c`") == [("tests/a/test_b.py", "test_c")]
    assert "test_every_test_that_a_page_names_exists" in functions_of(Path(__file__))
    assert "test_nothing" not in functions_of(Path(__file__))


def test_every_requirement_has_a_number_a_module_and_a_test() -> None:
    lines = (DOCS / "security" / "requirements.md").read_text("utf-8").splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| SRS-")]
    numbers = [row[0] for row in rows]
    assert len(rows) > 30
    assert numbers == sorted(set(numbers))
    for number, requirement, module, tests in rows:
        assert len(requirement) > 20, number
        assert (ROOT / module.strip("`")).exists(), f"{number}: {module}"
        assert TEST.sub("", tests).strip(", ") == "", number
        assert TEST.findall(tests), number


def test_every_threat_has_a_kind_and_something_that_meets_it() -> None:
    text = (DOCS / "security" / "threat-model.md").read_text("utf-8")
    rows = re.findall(r"^\| ([STRIDE, ]+) \| (.+?) \| (.*?) \| (.*?) \| (.*?) ?\|$", text, re.MULTILINE)
    assert len(rows) > 35
    assert {kind for kinds, *_ in rows for kind in kinds.split(", ")} == set("STRIDE")
    for _, threat, met, shown, _ in rows:
        assert met, threat
        # What no test shows is said to be the hospital's.
        assert TEST.findall(shown) or met.startswith("yours"), threat


def test_the_disclosure_has_every_section_of_the_form() -> None:
    text = (DOCS / "security" / "mds2.md").read_text("utf-8")
    assert tuple(re.findall(r"^## (\w+): ", text, re.MULTILINE)) == SECTIONS
    assert f"Release {__version__}." in text


@pytest.mark.parametrize(
    "page",
    [
        ROOT / "README.md",
        ROOT / "SECURITY.md",
        DOCS / "operations.md",
        DOCS / "README.md",
        *(DOCS / "security" / n for n in ("threat-model.md", "mds2.md")),
    ],
    ids=lambda page: page.name,
)
def test_pages_say_that_it_is_for_research_alone(page: Path) -> None:
    assert RESEARCH.search(page.read_text("utf-8").replace("*", ""))
