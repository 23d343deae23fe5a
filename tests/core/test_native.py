"""Open3D loads while other threads import, and a failure is reported."""

from __future__ import annotations

import importlib
from types import ModuleType

import pytest

from specimap_core import native
from specimap_core.errors import BackendUnavailableError


def failing(monkeypatch: pytest.MonkeyPatch, times: int) -> list[str]:
    """Let the import of Open3D fail as it does where another thread imports; the list notes the attempts."""
    attempts: list[str] = []
    real = importlib.import_module

    def imported(name: str) -> ModuleType:
        if name != "open3d":
            return real(name)
        attempts.append(name)
        if len(attempts) <= times:
            raise RuntimeError("dictionary changed size during iteration")
        return ModuleType(name)

    monkeypatch.setattr(importlib, "import_module", imported)
    return attempts


def test_an_import_beside_another_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = failing(monkeypatch, times=2)
    assert native.open3d().__name__ == "open3d"
    assert len(attempts) == 3


def test_an_import_that_fails_again_and_again_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    attempts = failing(monkeypatch, times=1000)
    with pytest.raises(BackendUnavailableError, match="changed size"):
        native.open3d()
    assert len(attempts) == native.ATTEMPTS
