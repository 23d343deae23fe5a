"""Check which files an acquisition lacks before a job can run on it. Reads rows only, no file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import PurePosixPath
from typing import Protocol

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.tables import StoredFile

LEAST_PHOTOS = 6
"""The pipeline's own limit; it refuses fewer."""
HEADER, DATA = ".hdr", ".raw"
"""Suffixes of a cube in two files; a file with any other suffix is a whole cube."""


class FileRow(Protocol):
    """What counts of a file: its row, or these columns of it."""

    @property
    def role(self) -> str:
        """Role."""

    @property
    def label(self) -> str:
        """Name in results."""

    @property
    def state(self) -> str:
        """``accepted`` or ``refused``."""


def files_of(session: Session, acquisitions: list[str]) -> dict[str, list[FileRow]]:
    """Return the files of each acquisition, by one query; an acquisition without any has an empty list."""
    files = sa.select(StoredFile.acquisition_id, StoredFile.role, StoredFile.label, StoredFile.state)
    found: dict[str, list[FileRow]] = {acquisition: [] for acquisition in acquisitions}
    for row in session.execute(files.where(StoredFile.acquisition_id.in_(acquisitions))):
        found[row.acquisition_id].append(row)
    return found


def missing(session: Session, acquisition_id: str) -> list[str]:
    """Return a sentence for each missing file; empty where a job can run. Refused files do not count."""
    return missing_of(files_of(session, [acquisition_id])[acquisition_id])


def missing_of(files: Iterable[FileRow]) -> list[str]:
    """Do as :func:`missing` does with the files of one acquisition."""
    labels: dict[str, set[str]] = {}
    for file in files:
        if file.state == "accepted":
            labels.setdefault(file.role, set()).add(file.label)
    sentences = []
    photos = len(labels.get("photo", ()))
    if photos < LEAST_PHOTOS:
        sentences.append(f"{photos} usable photos; at least {LEAST_PHOTOS} are needed.")
    if "cube" not in labels:
        sentences.append("There is no usable cube.")
    for role in ("cube", "white", "dark"):
        if role in labels:
            sentences += _incomplete(role, labels[role])
    if "dark" in labels and "white" not in labels:
        sentences.append("The dark reference has no white one beside it.")
    return sentences


def _incomplete(role: str, labels: set[str]) -> list[str]:
    ends = {PurePosixPath(label).suffix.lower() for label in labels}
    name = "cube" if role == "cube" else f"{role} reference"
    if ends - {HEADER, DATA} or ends == {HEADER, DATA}:
        return []
    other = f"data file ({role}{DATA})" if HEADER in ends else f"header ({role}{HEADER})"
    return [f"The {name}'s {other} has not arrived."]
