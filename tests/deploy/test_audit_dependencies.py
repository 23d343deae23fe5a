"""The audit of dependencies never passes in silence over what it could not ask about."""

from __future__ import annotations

import importlib.util
from types import ModuleType
from typing import Any

import pytest

from tests.support.places import ROOT


@pytest.fixture(scope="module")
def audit() -> ModuleType:
    spec = importlib.util.spec_from_file_location("audit_dependencies", ROOT / "docker" / "audit_dependencies.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


SOUND = {"name": "numpy", "version": "2.2.0", "vulns": []}
WEAK = {"name": "pillow", "version": "1", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2"]}]}
PASSED_OVER = {"name": "torch", "skip_reason": "not found"}
SOUND_PAGES: dict[str, Any] = {"vulnerabilities": {}}
WEAK_PAGES = {"vulnerabilities": {"vite": {"severity": "high"}}}
AWAY = {"message": "405 Method Not Allowed", "error": {}}


@pytest.mark.parametrize(
    ("python", "pages", "status", "words"),
    [
        ([SOUND], SOUND_PAGES, 0, ["No package has a known weakness"]),
        ([SOUND, WEAK], SOUND_PAGES, 1, ["pillow 1: PYSEC-1 (mended in 2)"]),
        ([SOUND], WEAK_PAGES, 1, ["vite: high"]),
        ([SOUND, PASSED_OVER], SOUND_PAGES, 3, ["NOT ASKED", "1 of 2 packages: torch", "no proof"]),
        ([SOUND], AWAY, 3, ["NOT ASKED", "405"]),
        ([SOUND], None, 3, ["NOT ASKED", "a complaint"]),
        (None, SOUND_PAGES, 3, ["NOT ASKED", "a complaint"]),
        # A weakness that is known outweighs what could not be asked.
        ([WEAK, PASSED_OVER], AWAY, 1, ["PYSEC-1", "NOT ASKED"]),
    ],
)
def test_status_tells_sound_from_weak_and_from_not_asked(
    audit: ModuleType,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    python: list[dict[str, Any]] | None,
    pages: dict[str, Any] | None,
    status: int,
    words: list[str],
) -> None:
    answer = None if python is None else {"dependencies": python}
    found = audit.judge_python(answer, "a complaint", len(python or []) or 1)
    monkeypatch.setattr(audit, "python_packages", lambda: found)
    monkeypatch.setattr(audit, "page_packages", lambda: audit.judge_pages(pages, "a complaint"))
    assert audit.main() == status
    said = capsys.readouterr().out
    assert all(word in said for word in words)


def test_an_answer_for_fewer_packages_is_none(audit: ModuleType) -> None:
    weak, unasked = audit.judge_python({"dependencies": [SOUND]}, "", 2)
    assert weak == []
    assert len(unasked) == 1


def test_a_program_that_is_missing_is_no_answer(audit: ModuleType) -> None:
    assert audit._json(["/nowhere/pip-audit"])[0] is None
