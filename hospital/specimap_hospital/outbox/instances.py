"""The rows of a set's objects, written by the one sender that holds the set."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_hospital.outbox.rows import Claim, current
from specimap_infra.database import Database, rows_changed
from specimap_infra.ids import new_id
from specimap_infra.tables import DicomInstance, DicomSet

if TYPE_CHECKING:
    from specimap_hospital.dicom.model import DicomObject

_LONGEST_REASON = 64


class ClaimLostError(Exception):
    """The set is another sender's now, or was asked for anew."""


@dataclass(frozen=True)
class Known:
    """What is known of an object before it is sent."""

    id: str
    state: str
    attempts: int


def take_stock(database: Database, held: Claim, objects: Sequence[DicomObject]) -> dict[str, Known]:
    """Let the set have rows for exactly these objects. Returns them by the objects' UIDs.

    Raises:
        ClaimLostError: the set is not held any more. DatabaseUnavailableError.
    """
    with database.session() as session:
        _hold(session, held)
        of_set = DicomInstance.set_id == held.set_id
        there = {row.sop_instance_uid: row for row in session.scalars(sa.select(DicomInstance).where(of_set))}
        wanted = {made.sop_instance_uid for made in objects}
        for uid in there.keys() - wanted:
            # Of another study context, or of a photo that was deleted.
            session.delete(there.pop(uid))
        for number, made in enumerate(objects, 1):
            row = there.get(made.sop_instance_uid)
            if row is None:
                row = there[made.sop_instance_uid] = DicomInstance(
                    id=new_id("dci"),
                    set_id=held.set_id,
                    kind=made.kind,
                    sop_class_uid=made.sop_class_uid,
                    sop_instance_uid=made.sop_instance_uid,
                    state="waiting",
                    attempts=0,
                )
                session.add(row)
            row.number, row.size = number, made.path.stat().st_size
        return {uid: Known(row.id, row.state, row.attempts) for uid, row in there.items()}


def begin(database: Database, held: Claim, instance: str) -> None:
    """Note that an object is about to be sent. Raises ClaimLostError, DatabaseUnavailableError."""
    with database.session() as session:
        _hold(session, held)
        change = sa.update(DicomInstance).where(DicomInstance.id == instance)
        session.execute(change.values(attempts=DicomInstance.attempts + 1), execution_options=_PLAIN)


def settle(
    database: Database, held: Claim, instance: str, state: str, now: datetime.datetime, reason: str | None = None
) -> None:
    """Note how the sending of an object ended. Raises ClaimLostError, DatabaseUnavailableError."""
    with database.session() as session:
        _hold(session, held)
        values = {"state": state, "reason": None if reason is None else reason[:_LONGEST_REASON]}
        if state == "sent":
            values["sent_at"] = now  # type: ignore[assignment]
        change = sa.update(DicomInstance).where(DicomInstance.id == instance)
        session.execute(change.values(**values), execution_options=_PLAIN)


def counted(database: Database, set_id: str) -> dict[str, int]:
    """Count a set's objects by state. Raises DatabaseUnavailableError."""
    query = sa.select(DicomInstance.state, sa.func.count()).where(DicomInstance.set_id == set_id)
    with database.session() as session:
        return {str(state): int(count) for state, count in session.execute(query.group_by(DicomInstance.state))}


_PLAIN = {"synchronize_session": False}


def _hold(session: Session, held: Claim) -> None:
    """Let nobody else change the set until the transaction ends."""
    # A write that changes nothing, since SQLite locks by writes only.
    locked = sa.update(DicomSet).where(current(held)).values(holder=held.holder)
    if not rows_changed(session.execute(locked, execution_options=_PLAIN)):
        raise ClaimLostError
