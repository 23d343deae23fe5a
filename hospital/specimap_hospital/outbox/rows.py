"""The rows of the outbox: what is asked for, claimed by senders, and how it ended.

A claim lasts for a while and is renewed; who holds it writes alone. Times are those that the caller gives.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_infra.claims import take_due
from specimap_infra.database import Database, rows_changed
from specimap_infra.errors import StudyMissingError
from specimap_infra.ids import new_id
from specimap_infra.labels import lock_cloud
from specimap_infra.tables import CloudRow, DicomInstance, DicomSet, Job, SealedStudy

AUTOMATIC = "service"
"""Stands for the key of what nobody asked for."""
MOST_AT_ONCE = 100


@dataclass(frozen=True)
class Claim:
    """A set that a sender works on. ``state``: ``waiting`` to be sent, or ``sent`` to be committed."""

    set_id: str
    cloud_id: str
    options: Mapping[str, Any]
    study_version: int
    state: str
    attempt: int
    holder: str
    reason: str | None


# ---- what is asked for --------------------------------------------------------------------------------


def request_set(
    session: Session, cloud_id: str, options: Mapping[str, Any], by: str, now: datetime.datetime, *, again: bool
) -> DicomSet:
    """Have a set of a cloud sent: made where there is none, tried anew where it failed, and with ``again`` in any case.

    Raises:
        NotFoundError: there is no such cloud. StudyMissingError: its acquisition has no study context.
    """
    lock_cloud(session, cloud_id)
    version = _study_version(session, cloud_id)
    if version is None:
        raise StudyMissingError(
            "The acquisition has no study context, so nobody knows whose the objects are.",
            advice="PUT /v1/acquisitions/{id}/study first.",
            cloud_id=cloud_id,
        )
    rows = session.scalars(sa.select(DicomSet).where(DicomSet.cloud_id == cloud_id)).all()
    row = next((row for row in rows if row.options == options), None)
    if row is None:
        row = _new_set(cloud_id, dict(options), version, by, now)
        session.add(row)
    elif again or row.state == "failed" or row.study_version != version:
        _revive(session, row, version, now, all_of_it=again or row.study_version != version)
    session.flush()
    return row


def add_wanted(database: Database, now: datetime.datetime, *, automatic: bool) -> int:
    """Revive sets whose study context has changed, and with ``automatic`` add the first sets of results that have a
    study context and no first set.

    Returns: how many clouds it looked at; safe to do in several processes at once. Raises DatabaseUnavailableError.
    """
    made = (
        sa.select(CloudRow.id)
        .join(SealedStudy, SealedStudy.acquisition_id == CloudRow.acquisition_id)
        .join(Job, sa.and_(Job.id == CloudRow.job_id, Job.state == "succeeded"))
        .order_by(CloudRow.id)
        .limit(MOST_AT_ONCE)
    )
    changed = made.where(
        sa.exists().where(DicomSet.cloud_id == CloudRow.id, DicomSet.study_version != SealedStudy.version)
    )
    lacking = made.where(~sa.exists().where(DicomSet.cloud_id == CloudRow.id, DicomSet.first))
    with database.session() as session:
        clouds = set(session.scalars(changed)) | (set(session.scalars(lacking)) if automatic else set())
    for cloud_id in sorted(clouds):
        with database.session() as session:
            try:
                lock_cloud(session, cloud_id)
            except NotFoundError:
                continue
            version = _study_version(session, cloud_id)
            if version is None:
                continue
            rows = session.scalars(sa.select(DicomSet).where(DicomSet.cloud_id == cloud_id)).all()
            for row in rows:
                if row.study_version != version:
                    _revive(session, row, version, now, all_of_it=True)
            if automatic and not any(row.first for row in rows):
                session.add(_new_set(cloud_id, {}, version, AUTOMATIC, now))
    return len(clouds)


def _study_version(session: Session, cloud_id: str) -> int | None:
    query = sa.select(SealedStudy.version).join(CloudRow, CloudRow.acquisition_id == SealedStudy.acquisition_id)
    return session.scalar(query.where(CloudRow.id == cloud_id))


def _new_set(cloud_id: str, options: dict[str, Any], version: int, by: str, now: datetime.datetime) -> DicomSet:
    return DicomSet(
        id=new_id("dcs"),
        cloud_id=cloud_id,
        options=options,
        first=not options,
        study_version=version,
        state="waiting",
        next_at=now,
        held_until=now,
        created_by=by,
    )


def _revive(session: Session, row: DicomSet, version: int, now: datetime.datetime, *, all_of_it: bool) -> None:
    """Let a set be sent: all its objects, whatever the archive has of them, or those that it does not have."""
    row.state, row.study_version, row.attempts, row.next_at = "waiting", version, 0, now
    row.reason, row.transaction_uid, row.settled_at = None, None, None
    change = sa.update(DicomInstance).where(DicomInstance.set_id == row.id)
    if not all_of_it:
        change = change.where(DicomInstance.state == "failed")
    # Attempts of before would let the sender ask whether the archive has it, and it may have another one of this name.
    values: dict[str, Any] = {"state": "waiting", "reason": None, **({"attempts": 0} if all_of_it else {})}
    session.execute(change.values(**values), execution_options={"synchronize_session": False})


# ---- claims -------------------------------------------------------------------------------------------


def claim(
    database: Database, holder: str, now: datetime.datetime, lease: datetime.timedelta, states: Sequence[str]
) -> Claim | None:
    """Take the set that has been due longest, of those in ``states``; None where none is due.

    Raises DatabaseUnavailableError.
    """
    due = sa.and_(DicomSet.state.in_(states), DicomSet.next_at <= now, DicomSet.held_until <= now)
    row = take_due(database, DicomSet, due, holder=holder, held_until=now + lease)
    if row is None:
        return None
    return Claim(row.id, row.cloud_id, row.options, row.study_version, row.state, row.attempts, holder, row.reason)


def renew(database: Database, held: Claim, until: datetime.datetime) -> bool:
    """Hold a claim for longer; False where it is another's, or gone. Raises DatabaseUnavailableError."""
    with database.session() as session:
        change = sa.update(DicomSet).where(current(held)).values(held_until=until)
        return bool(rows_changed(session.execute(change, execution_options={"synchronize_session": False})))


def finish(database: Database, held: Claim, now: datetime.datetime, **values: Any) -> bool:
    """Write how a claim ended, and give it back; False where it is another's, or the set was asked for anew meanwhile.

    Raises DatabaseUnavailableError.
    """
    with database.session() as session:
        changed = session.execute(
            sa.update(DicomSet).where(current(held)).values(**values, holder=None, held_until=now),
            execution_options={"synchronize_session": False},
        )
        if rows_changed(changed):
            return True
        own = sa.and_(DicomSet.id == held.set_id, DicomSet.holder == held.holder)
        given = sa.update(DicomSet).where(own).values(holder=None, held_until=now)
        session.execute(given, execution_options={"synchronize_session": False})
        return False


def current(held: Claim) -> sa.ColumnElement[bool]:
    """Make the condition that a claim lasts, and the set was not asked for anew since."""
    return sa.and_(
        DicomSet.id == held.set_id,
        DicomSet.holder == held.holder,
        DicomSet.attempts == held.attempt,
        DicomSet.study_version == held.study_version,
    )
