"""Sealed entries of the audit trail, in the order of the chain."""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from typing import Any

import sqlalchemy as sa

from specimap_infra.audit.records import FIELDS
from specimap_infra.database import Database
from specimap_infra.tables import AuditEntry

BATCH = 500
_COLUMNS = [AuditEntry.__table__.c[name] for name in (*FIELDS, "seq", "previous_hash", "hash")]


def sealed_after(
    database: Database, seq: int, limit: int = BATCH, since: datetime.datetime | None = None
) -> list[dict[str, Any]]:
    """Return the next entries after a place in the chain. Raises DatabaseUnavailableError."""
    query = sa.select(*_COLUMNS).where(AuditEntry.seq > seq).order_by(AuditEntry.seq).limit(limit)
    if since is not None:
        query = query.where(AuditEntry.at >= since)
    with database.session() as session:
        return [dict(row) for row in session.execute(query).mappings()]


def all_sealed(database: Database, since: datetime.datetime | None = None) -> Iterator[dict[str, Any]]:
    """Yield all entries, or those since a time. Raises DatabaseUnavailableError."""
    seq = 0
    while found := sealed_after(database, seq, since=since):
        yield from found
        seq = found[-1]["seq"]
