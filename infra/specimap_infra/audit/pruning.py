"""Removal of the oldest entries of the audit trail, so that what is left can still be verified."""

from __future__ import annotations

import datetime

import sqlalchemy as sa

from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.sealing import locked_head, seal
from specimap_infra.database import Database, rows_changed
from specimap_infra.tables import AuditCursor, AuditEntry

BATCH = 2000
ACTION = "audit.prune"


def prune(database: Database, keys: ChainKeys, before: datetime.datetime, forwarded_to: str = "") -> int:
    """Remove up to a batch of entries from the beginning of the chain that are older; return how many.

    First an entry of the trail names the last record that goes, and its hash; then the head holds both, as the place
    where the chain begins. Only then do rows go. Stopped anywhere, the next call goes on.

    Args:
        forwarded_to: a destination that has to get entries before they may go.

    Raises:
        DatabaseUnavailableError: the server cannot be reached.
    """
    gone = _remove(database)
    if gone:
        return gone
    seal(database, keys)
    with database.session() as session:
        head = locked_head(session)
        # Entries are nearly in the order of time; one that is young keeps all after it.
        last = session.scalar(sa.select(sa.func.min(AuditEntry.seq)).where(AuditEntry.at >= before))
        through = head.seq if last is None else last - 1
        if forwarded_to:
            sent = session.scalar(sa.select(AuditCursor.seq).where(AuditCursor.destination == forwarded_to))
            through = min(through, sent or 0)
        if through <= head.pruned_seq:
            return 0
        found = session.scalars(sa.select(AuditEntry.hash).where(AuditEntry.seq == through)).one()
        if found is None:
            return 0
        entries = through - head.pruned_seq
        session.add(
            AuditEntry(
                key_id="service",
                project_id="",
                action=ACTION,
                target="audit",
                kind="service",
                details={"through": through, "hash": found, "entries": entries},
                correlation_id="",
            )
        )
        head.pruned_seq, head.pruned_hash = through, found
    return _remove(database)


def _remove(database: Database) -> int:
    with database.session() as session:
        head = locked_head(session)
        some = sa.select(AuditEntry.id).where(AuditEntry.seq <= head.pruned_seq).order_by(AuditEntry.seq).limit(BATCH)
        gone = sa.delete(AuditEntry).where(AuditEntry.id.in_(some))
        return rows_changed(session.execute(gone.execution_options(synchronize_session=False)))
