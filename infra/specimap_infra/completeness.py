"""Check which files an acquisition lacks before a job can run on it. Reads rows only, no file."""

from __future__ import annotations

from pathlib import PurePosixPath

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.tables import StoredFile

LEAST_PHOTOS = 6
"""The pipeline's own limit; it refuses fewer."""
HEADER, DATA = ".hdr", ".raw"
"""Suffixes of a cube in two files; a file with any other suffix is a whole cube."""


def missing(session: Session, acquisition_id: str) -> list[str]:
    """Return a sentence for each missing file; empty where a job can run. Refused files do not count."""
    accepted = session.execute(
        sa.select(StoredFile.role, StoredFile.label).where(
            StoredFile.acquisition_id == acquisition_id, StoredFile.state == "accepted"
        )
    )
    labels: dict[str, set[str]] = {}
    for role, label in accepted:
        labels.setdefault(role, set()).add(label)
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
