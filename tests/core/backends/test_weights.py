"""Weights files: told apart by their sha256, held to the pinned one, named by a variable."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from specimap_core.errors import BackendUnavailableError
from specimap_core.reconstruct.backends import weights
from specimap_core.reconstruct.backends.weights import Weights, find_weights, hash_cache_in, named_path, sha256_of


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


# ---- what another program has read already ------------------------------------------------------------


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The cache folder, with files of any size kept in it; this program's own memory is cleared."""
    monkeypatch.setattr(weights, "KEPT_FROM_BYTES", 0)
    weights._sha256.cache_clear()
    folder = hash_cache_in({"XDG_CACHE_HOME": str(tmp_path / "cache")})
    assert folder is not None
    yield folder
    weights._sha256.cache_clear()


def read_anew(path: Path, cache: Path) -> str:
    weights._sha256.cache_clear()
    return sha256_of(path, cache)


def test_a_sha256_is_kept_for_the_next_program_until_the_file_changes(tmp_path: Path, cache: Path) -> None:
    file = tmp_path / "weights.pth"
    file.write_bytes(b"weights")
    os.utime(file, ns=(0, 10**18))
    digest = hashlib.sha256(b"weights").hexdigest()
    assert read_anew(file, cache) == digest
    (note,) = cache.iterdir()
    assert note.read_text("ascii") == digest
    note.write_text("1" * 64, "ascii")
    assert read_anew(file, cache) == "1" * 64, "it is not read again"
    file.write_bytes(b"changed")
    os.utime(file, ns=(0, 10**18 + 1))
    assert read_anew(file, cache) == hashlib.sha256(b"changed").hexdigest()
    assert len(list(cache.iterdir())) == 2


@pytest.mark.parametrize("kept", ["", "12", "z" * 64])
def test_a_kept_sha256_that_is_none_is_not_believed(tmp_path: Path, cache: Path, kept: str) -> None:
    file = tmp_path / "weights.pth"
    file.write_bytes(b"weights")
    digest = read_anew(file, cache)
    (note,) = cache.iterdir()
    note.write_text(kept, "ascii")
    assert read_anew(file, cache) == digest == note.read_text("ascii")


def test_the_cache_is_in_the_users_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hash_cache_in({"XDG_CACHE_HOME": "/a"}) == Path("/a/specimap/weights")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert hash_cache_in({}) == tmp_path / ".cache" / "specimap" / "weights"


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path, cache: Path) -> None:
    file = tmp_path / "weights.pth"
    file.write_bytes(b"weights")
    assert read_anew(file, file / "weights") == hashlib.sha256(b"weights").hexdigest()
    assert not cache.exists()


def test_small_files_are_not_kept(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(weights, "KEPT_FROM_BYTES", 8)
    file = tmp_path / "weights.pth"
    file.write_bytes(b"weights")
    assert read_anew(file, cache) == hashlib.sha256(b"weights").hexdigest()
    assert not cache.exists()
