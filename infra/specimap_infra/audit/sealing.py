"""The sealer: puts committed entries into the chain."""

from __future__ import annotations

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.audit.records import FIELDS, ChainKeys, canonical
from specimap_infra.database import Database
from specimap_infra.tables import AuditEntry, AuditHead

BATCH = 500
"""Entries of one transaction."""
HEAD = 1
_TABLE = AuditEntry.__table__
_COLUMNS = [_TABLE.c[name] for name in FIELDS]


def locked_head(session: Session) -> AuditHead:
    """Return the end of the chain, locked until the transaction ends; other sealers wait."""
    # An update locks on both databases; SQLite would begin a reading transaction with a query.
    session.execute(
        sa.update(AuditHead).where(AuditHead.id == HEAD).values(id=HEAD),
        execution_options={"synchronize_session": False},
    )
    return session.get_one(AuditHead, HEAD, populate_existing=True)


def has_unsealed(session: Session) -> bool:
    """Return whether entries wait to be sealed."""
    return session.scalar(sa.select(AuditEntry.id).where(AuditEntry.seq.is_(None)).limit(1)) is not None


def seal(database: Database, keys: ChainKeys) -> int:
    """Chain entries that have been committed, in the order of their ids; return how many. Safe in several programs.

    Raises:
        DatabaseUnavailableError: the server cannot be reached.
    """
    sealed = 0
    while (count := _seal_some(database, keys)) == BATCH:
        sealed += count
    return sealed + count


def _seal_some(database: Database, keys: ChainKeys) -> int:
    with database.session() as session:
        if not has_unsealed(session):
            return 0
        head = locked_head(session)
        query = sa.select(*_COLUMNS).where(AuditEntry.seq.is_(None)).order_by(AuditEntry.id).limit(BATCH)
        changes = []
        seq, previous = head.seq, head.hash
        for row in map(dict, session.execute(query).mappings()):
            seq += 1
            found = keys.hash_of(canonical(row, seq, previous))
            changes.append({"entry": row["id"], "seq": seq, "previous_hash": previous, "hash": found})
            previous = found
        if changes:
            in_place = sa.update(AuditEntry).where(_TABLE.c.id == sa.bindparam("entry"))
            session.connection().execute(in_place, changes)
        head.seq, head.hash = seq, previous
        return len(changes)
