"""Stored files that rows refer to: what a backup holds, and what a storage must hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.tables import Base

PLACES = ("acquisitions", "jobs", "clouds", "exports")
"""Top folders of the storage; every stored file that is more than temporary lies in one of them."""
REMAKEABLE = frozenset({"artefacts", "exports"})
"""Tables whose files can be made again from others."""
COLUMNS: dict[str, tuple[str, bool]] = {
    "files": ("storage_key", False),
    "artefacts": ("storage_key", False),
    "clouds": ("prefix", True),
    "labels": ("storage_prefix", True),
    "exports": ("storage_key", False),
}
"""For each table whose rows refer to files: the column, and whether it names a folder."""


@dataclass(frozen=True)
class Reference:
    """A stored file, or the files of a folder, that a row refers to. They never change once a row does."""

    table: str
    key: str
    folder: bool
    size: int
    """Bytes of all its files; 0 where the row does not know."""
    sha256: str
    """Of a file; empty where the row does not know."""


def reference_of(table: str, row: Mapping[Any, Any]) -> Reference | None:
    """Return what a row refers to; None where it refers to no file."""
    column, folder = COLUMNS.get(table, ("", False))
    key = row[column] if column else None
    if not key:
        return None
    digest = row["sha256"] if table == "files" else ""
    return Reference(table, key, folder, int(row.get("size") or 0), digest)


def column_of(table: str) -> sa.Column[str]:
    """Return the column of a table that names a file or folder."""
    return Base.metadata.tables[table].c[COLUMNS[table][0]]


def references(session: Session) -> Iterator[Reference]:
    """Yield what the rows of a database of this version's schema refer to."""
    for name in COLUMNS:
        for row in session.execute(sa.select(Base.metadata.tables[name])).mappings():
            if (found := reference_of(name, row)) is not None:
                yield found
