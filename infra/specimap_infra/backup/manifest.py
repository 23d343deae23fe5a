"""What lies in the folder of a backup."""

from __future__ import annotations

import datetime
import hashlib
from collections.abc import Callable, Iterator
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from specimap_core.errors import CancelledError
from specimap_infra.errors import BackupInvalidError

FORMAT = 1
MANIFEST = "backup.json"
"""Written last: a folder without it is no backup."""
ROWS = "rows.jsonl.gz"
"""A line for each row: its table and its values."""
LIST = "files.jsonl"
"""A line for each file: an ``Entry``."""
FILES = "files"
"""Folder of the files, by their keys in the storage."""
PIECE = 1024 * 1024

Progress = Callable[[str, float], None]
"""Told which part of the work is under way, and its share, 0 to 1."""
Cancelled = Callable[[], bool]


class Entry(BaseModel):
    """A file of a backup."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: str
    size: int
    sha256: str


class Manifest(BaseModel):
    """What a backup says of itself."""

    model_config = ConfigDict(frozen=True)

    format: int
    program: str
    """Version of the program that made it."""
    made_at: datetime.datetime
    revision: str
    """Of the schema that the rows have."""
    rows: dict[str, int]
    """Rows by table."""
    rows_sha256: str
    files: int
    bytes: int
    files_sha256: str
    """Of the list of files."""
    missing: list[str]
    """Keys of files that rows refer to, and that the storage lacked."""
    damaged: list[str]
    """Keys of files that had another checksum than when they were uploaded."""


def read_manifest(folder: Path) -> Manifest:
    """Read what a backup says of itself.

    Raises:
        BackupInvalidError: it is no backup, or one that this program cannot read.
    """
    path = folder / MANIFEST
    try:
        manifest = Manifest.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise BackupInvalidError(
            f"{folder} is not a whole backup: its {MANIFEST} is missing or does not read.",
            advice="Name the folder that `specimap backup --to` has made.",
        ) from error
    if manifest.format > FORMAT:
        raise BackupInvalidError(
            f"The backup was made by release {manifest.program}, in a format that this one does not know.",
            advice=f"Restore it with release {manifest.program} or a later one.",
            program=manifest.program,
        )
    return manifest


def read_entries(folder: Path, manifest: Manifest) -> list[Entry]:
    """Read the list of the backup's files.

    Raises:
        BackupInvalidError: it is not the one that the backup was made with.
    """
    if digest_of(folder / LIST) != manifest.files_sha256:
        raise changed(LIST)
    return [Entry.model_validate_json(line) for line in (folder / LIST).read_text("utf-8").splitlines()]


def digest_of(path: Path) -> str:
    """Return the SHA-256 of a file; empty where there is none."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        return ""


def changed(name: str) -> BackupInvalidError:
    """Make the error for a part of a backup that is not as it was written."""
    return BackupInvalidError(
        f"{name} of the backup is missing or has changed since it was made: its checksum differs.",
        advice="Copy the backup again from where it was kept, or use another one.",
        name=name,
    )


def hashed(pieces: Iterator[bytes], target: Path, cancelled: Cancelled) -> tuple[int, str]:
    """Write pieces to a new file; return its size and SHA-256.

    Raises:
        CancelledError: ``cancelled`` came true.
    """
    digest, size = hashlib.sha256(), 0
    with open(target, "xb") as file:
        for piece in pieces:
            if cancelled():
                raise CancelledError("Stopped on request.", advice="Give the same command again.")
            file.write(piece)
            digest.update(piece)
            size += len(piece)
    return size, digest.hexdigest()


def pieces_of(path: Path) -> Iterator[bytes]:
    """Read a file piece by piece."""
    with open(path, "rb") as file:
        while piece := file.read(PIECE):
            yield piece
