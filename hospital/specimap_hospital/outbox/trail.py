"""Entries of the audit trail about what was sent. They hold ids and numbers alone."""

from __future__ import annotations

import sqlalchemy as sa

from specimap_hospital.outbox.instances import counted
from specimap_hospital.outbox.rows import Claim
from specimap_infra.database import Database
from specimap_infra.housekeeping import AUDITED_AS
from specimap_infra.projects import project_of
from specimap_infra.tables import AuditEntry, CloudRow


def note_end(database: Database, held: Claim, state: str, reason: str | None) -> None:
    """Write that a set was sent, committed, or given up. Raises DatabaseUnavailableError."""
    counts = counted(database, held.set_id)
    with database.session() as session:
        project = project_of(session, held.cloud_id)
        if project is None or session.scalar(sa.select(CloudRow.id).where(CloudRow.id == held.cloud_id)) is None:
            return
        session.add(
            AuditEntry(
                key_id=AUDITED_AS,
                project_id=project,
                action=f"dicom.{ {'sent': 'send', 'committed': 'commit'}.get(state, 'fail') }",
                target=held.cloud_id,
                details={"set": held.set_id, "objects": counts, **({"reason": reason} if reason else {})},
                correlation_id="",
            )
        )
