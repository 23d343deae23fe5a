"""docs/operations.md: the guide has every code, and says what the program says."""

from __future__ import annotations

import re

import pytest

from specimap_service import failure_guide
from specimap_service.http_status import HTTP_STATUS
from tests.support.places import DOCS

PAGE = (DOCS / "operations.md").read_text("utf-8")


def test_the_guide_is_the_one_that_the_program_prints() -> None:
    guide = PAGE.split("<!-- guide -->\n")[1].split("\n<!-- /guide -->")[0]
    assert guide == failure_guide.failure_guide(), "print it anew: python -m specimap_service.failure_guide"


def test_the_guide_names_every_code_of_the_errors_page() -> None:
    listed = set(re.findall(r"^\| `(\w+)` \| \d+ \|", (DOCS / "errors.md").read_text("utf-8"), re.MULTILINE))
    guide = failure_guide.failure_guide()
    rows = dict(re.findall(r"^\| `(\w+)` \| (\d+) \|", guide, re.MULTILINE))
    others = dict(re.findall(r"`(\w+)` \((\d+)\)", guide))
    assert set(rows) | set(others) == listed
    assert not set(rows) & set(others)
    assert {code: int(status) for code, status in (rows | others).items()} == {
        e.code: s for e, s in HTTP_STATUS.items()
    }
    # A fault of the server's is never the sender's to mend.
    assert all(int(status) < 500 for status in others.values())


def test_a_fault_without_an_entry_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    left = {code: text for code, text in failure_guide.OPERATOR.items() if code != "stage_failed"}
    monkeypatch.setattr(failure_guide, "OPERATOR", left)
    with pytest.raises(TypeError, match="stage_failed"):
        failure_guide.failure_guide()


def test_every_flow_of_the_diagram_is_in_the_threat_model() -> None:
    flows = {int(number) for number in re.findall(r'-- "(\d+)', PAGE)}
    model = (DOCS / "security" / "threat-model.md").read_text("utf-8")
    described = {
        int(number)
        for numbers in re.findall(r"^### Flows? ([\d, and]+):", model, re.MULTILINE)
        for number in re.findall(r"\d+", numbers)
    }
    assert flows == described
