"""Weights files: given by path, identified by their sha256, checked against the one that the user pins."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from specimap_core.atomic import write_text
from specimap_core.errors import BackendUnavailableError, SpecimapError

KEPT_FROM_BYTES = 64 * 1024**2
"""Files from this size on are read once for all programs: a smaller one takes a tenth of a second."""


@dataclass(frozen=True)
class Weights:
    """A weights file: its size in bytes, its sha256, and the pinned one where there is one (they are equal)."""

    path: Path
    size: int
    sha256: str
    pinned: bool


def find_weights(
    name: str,
    variable: str,
    path: Path | None,
    *,
    pin: str | None = None,
    source: str = "",
    hash_cache: Path | None = None,
) -> Weights:
    """The weights of backend ``name``, which ``variable`` names; ``source`` says in the advice where they come from.

    ``pin``: the sha256 that the file must have, as 64 hexadecimal digits. ``hash_cache``: see :func:`sha256_of`.

    Raises:
        BackendUnavailableError: none is named, the file is not there, or it is another than the pinned one.
    """
    if path is None:
        raise BackendUnavailableError(
            f"{name} needs a weights file, and none is named.",
            advice=f"Set {variable} to its path. {source}".strip(),
            missing=variable,
        )
    if not path.is_file():
        raise BackendUnavailableError(
            f"There is no weights file {path} for {name}.",
            advice=f"Correct {variable}. {source}".strip(),
            missing=str(path),
        )
    wanted = pin_of(pin, variable)
    try:
        found = sha256_of(path, hash_cache)
    except OSError as error:
        raise BackendUnavailableError(
            f"The weights file {path} does not read: {error.strerror}.", advice=f"Correct {variable} or its rights."
        ) from error
    if wanted and found != wanted:
        raise BackendUnavailableError(
            f"The weights file {path.name} is not the pinned one: its sha256 starts with {found[:12]}, "
            f"{wanted[:12]} is wanted.",
            advice=f"Get the file again, or correct {variable}_SHA256.",
            sha256=found,
            pinned=wanted,
        )
    return Weights(path, path.stat().st_size, found, bool(wanted))


def pin_of(text: str | None, variable: str) -> str | None:
    """The pinned sha256 in lower case, None where none is given.

    Raises:
        BackendUnavailableError: it is not a sha256, and so would never match.
    """
    pin = (text or "").strip().lower()
    if pin and not _is_sha256(pin):
        raise BackendUnavailableError(
            f"{variable}_SHA256 is not a sha256: {pin[:80]!r}.",
            advice="Give the 64 hexadecimal digits that `sha256sum FILE` prints.",
        )
    return pin or None


def sha256_of(path: Path, hash_cache: Path | None = None) -> str:
    """The file's sha256, computed once for a file whose path, size and time of change stay the same.

    That of a large file is kept in the folder ``hash_cache``, where there is one that can be written.
    """
    status = os.stat(path)
    return _sha256(str(path.resolve()), status.st_size, status.st_mtime_ns, hash_cache)


@functools.lru_cache(maxsize=16)
def _sha256(path: str, size: int, mtime_ns: int, hash_cache: Path | None) -> str:
    note = hash_cache / _note_name(path, size, mtime_ns) if hash_cache and size >= KEPT_FROM_BYTES else None
    if note is not None:
        with suppress(OSError, ValueError):
            kept = note.read_text("ascii")
            if _is_sha256(kept):
                return kept
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if note is not None:
        with suppress(OSError, SpecimapError):
            write_text(note, digest)
    return digest


def _note_name(path: str, size: int, mtime_ns: int) -> str:
    """Name of the file that keeps the sha256 of that file."""
    return hashlib.sha256(f"{path}\n{size}\n{mtime_ns}".encode(errors="surrogateescape")).hexdigest()[:32]


def hash_cache_in(environment: Mapping[str, str]) -> Path | None:
    """The folder in the user's cache folder for the sha256 of large files; None without a home."""
    try:
        folder = Path(environment.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    except RuntimeError:
        return None
    return folder / "specimap" / "weights"


def _is_sha256(text: str) -> bool:
    return len(text) == 64 and set(text) <= set("0123456789abcdef")


def named_path(variable: str, environment: Mapping[str, str]) -> Path | None:
    """The path that a variable names, None where it is empty or unset."""
    value = environment.get(variable, "").strip()
    return Path(value).expanduser().resolve() if value else None
