"""Weights files: told apart by their sha256, held to the pinned one, named by a variable."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from specimap.core.errors import BackendUnavailableError
from specimap.core.reconstruct.learned.weights import Weights, find_weights, named_path


def find(path: Path | None, pin: str | None = None) -> Weights:
    return find_weights("mast3r", "SPECIMAP_MAST3R_WEIGHTS", path, pin=pin, source="The page says where.")


def test_weights_are_told_by_their_sha256(tmp_path: Path) -> None:
    file = tmp_path / "weights.pth"
    file.write_bytes(b"weights")
    digest = hashlib.sha256(b"weights").hexdigest()
    assert find(file) == Weights(file, 7, digest, False)
    assert find(file, digest.upper() + "\n").pinned
    file.write_bytes(b"changed")
    assert find(file).sha256 == hashlib.sha256(b"changed").hexdigest()


def test_other_weights_than_the_pinned_ones_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "weights.pth"
    file.write_bytes(b"weights")
    with pytest.raises(BackendUnavailableError, match="not the pinned one") as caught:
        find(file, "0" * 64)
    assert caught.value.details == {"sha256": hashlib.sha256(b"weights").hexdigest(), "pinned": "0" * 64}
    assert "SPECIMAP_MAST3R_WEIGHTS_SHA256" in caught.value.advice
    with pytest.raises(BackendUnavailableError, match="not a sha256"):
        find(file, "abc")


@pytest.mark.parametrize("name", [None, "nothing.pth", "."])
def test_missing_weights_are_named(tmp_path: Path, name: str | None) -> None:
    with pytest.raises(BackendUnavailableError, match="weights file") as caught:
        find(tmp_path / name if name else None)
    assert "SPECIMAP_MAST3R_WEIGHTS" in caught.value.advice
    assert "The page says where." in caught.value.advice


def test_a_variable_names_a_path() -> None:
    assert named_path("X", {"X": " /a/../b "}) == Path("/b")
    assert named_path("X", {"X": ""}) is None
    assert named_path("X", {}) is None
