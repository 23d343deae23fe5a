"""Commands that a person is told to type find the program."""

from __future__ import annotations

from pathlib import Path

import pytest

from specimap_cli.invocation import program


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    path = tmp_path / "a venv" / "bin" / "specimap"
    path.parent.mkdir(parents=True)
    path.write_text("#!/bin/sh\n")
    path.chmod(0o755)
    return path


def test_the_name_is_enough_where_it_finds_this_program(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", [str(installed), "demo"])
    monkeypatch.setenv("PATH", str(installed.parent))
    assert program() == "specimap"


@pytest.mark.parametrize("path", ["", "/nowhere"])
def test_the_path_is_named_where_the_name_finds_nothing(
    installed: Path, path: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", [str(installed), "demo"])
    monkeypatch.setenv("PATH", path)
    assert program() == f"'{installed}'"


def test_the_path_is_named_where_the_name_finds_another_program(
    installed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "specimap"
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    monkeypatch.setattr("sys.argv", [str(installed), "demo"])
    monkeypatch.setenv("PATH", str(tmp_path))
    assert program() == f"'{installed}'"


def test_a_program_that_is_not_called_by_a_file_has_the_usual_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["-c", "demo"])
    assert program() == "specimap"
