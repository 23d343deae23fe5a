"""Storage Commitment: the archive says that it keeps what it was sent, or what it lacks.

It may say so in the association in which it was asked, or later in one of its own, to the DICOM port.
"""

from __future__ import annotations

import datetime
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import sqlalchemy as sa

from specimap_hospital.connections import PeerError, association, entity
from specimap_hospital.outbox.rows import AUTOMATIC, Claim, current, finish
from specimap_hospital.outbox.trail import note_end
from specimap_infra.database import Database, rows_changed
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import DicomInstance, DicomSet

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

MODEL = "1.2.840.10008.1.20.1"
MODEL_INSTANCE = "1.2.840.10008.1.20.1.1"
NO_SUCH_INSTANCE = 0x0112
SAME_ASSOCIATION_SECONDS = 5.0
"""How long the answer is waited for where the question was asked."""
ANSWER_SECONDS = 600.0
"""How long the answer may take before it is asked for again."""
MOST_REQUESTS = 6
_PLAIN = {"synchronize_session": False}


def ask_for_commitment(
    database: Database, settings: ServiceSettings, held: Claim, clock: Callable[[], datetime.datetime]
) -> None:
    """Ask the archive for its commitment to the objects of a set that was sent, and wait a moment for the answer.

    The set becomes due again for the case that none comes. Raises DatabaseUnavailableError.
    """
    from pydicom.uid import generate_uid

    if not settings.pacs_host:
        finish(database, held, clock(), next_at=_never(clock), reason="commitment_without_host")
        return
    if held.attempt > MOST_REQUESTS:
        finish(database, held, clock(), next_at=_never(clock), reason="commitment_missing")
        logger().error("archive does not commit itself", set=held.set_id)
        return
    transaction = str(generate_uid(prefix=None))
    with database.session() as session:
        # Before it is asked: the answer may come to another process.
        noted = sa.update(DicomSet).where(current(held)).values(transaction_uid=transaction)
        if not rows_changed(session.execute(noted, execution_options=_PLAIN)):
            return
        of_set = sa.and_(DicomInstance.set_id == held.set_id, DicomInstance.state == "sent")
        rows = session.execute(sa.select(DicomInstance.sop_class_uid, DicomInstance.sop_instance_uid).where(of_set))
        objects = [(str(sop_class), str(instance)) for sop_class, instance in rows]
    wait = datetime.timedelta(seconds=ANSWER_SECONDS * held.attempt)
    reason = None
    try:
        _request(settings, transaction, objects, lambda report: take_report(database, report, clock))
    except PeerError as error:
        reason = error.reason
    finish(database, held, clock(), next_at=clock() + wait, reason=reason)
    if reason is not None:
        logger().warning("commitment not asked for", set=held.set_id, reason=reason)


def _never(clock: Callable[[], datetime.datetime]) -> datetime.datetime:
    return clock() + datetime.timedelta(days=36500)


def _request(
    settings: ServiceSettings, transaction: str, objects: list[tuple[str, str]], told: Callable[[Dataset], bool]
) -> None:
    from pydicom.dataset import Dataset
    from pynetdicom import evt

    answered = threading.Event()

    def report(event: Any) -> tuple[int, None]:
        status = 0x0000 if _taken(event, told) else 0x0110
        answered.set()
        return status, None

    asked = Dataset()
    asked.TransactionUID = transaction
    asked.ReferencedSOPSequence = []
    for sop_class, instance in objects:
        item = Dataset()
        item.ReferencedSOPClassUID, item.ReferencedSOPInstanceUID = sop_class, instance
        asked.ReferencedSOPSequence.append(item)
    ae = entity(settings, settings.pacs_seconds)
    ae.add_requested_context(MODEL)
    with association(
        ae,
        settings,
        settings.pacs_host,
        settings.pacs_port,
        settings.pacs_ae_title,
        tls=settings.pacs_tls == "on",
        evt_handlers=[(evt.EVT_N_EVENT_REPORT, report)],
    ) as peer:
        if not peer.accepted_contexts:
            raise PeerError("commitment_not_offered", passing=False)
        try:
            status, _ = peer.send_n_action(asked, 1, MODEL, MODEL_INSTANCE)
        except (ValueError, RuntimeError, AttributeError):
            raise PeerError("no_answer") from None
        code = status.get("Status") if status else None
        if code != 0x0000:
            raise PeerError("no_answer" if code is None else f"status_{code:04x}")
        answered.wait(SAME_ASSOCIATION_SECONDS)


def _taken(event: Any, told: Callable[[Dataset], bool]) -> bool:
    try:
        return told(event.event_information)
    except Exception as error:
        # An archive's answer must not end the association's thread without one of ours.
        logger().warning("commitment not read", error=type(error).__name__)
        return False


def take_report(database: Database, report: Dataset, clock: Callable[[], datetime.datetime]) -> bool:
    """Write what an archive's report says; False where nobody asked for it. Raises DatabaseUnavailableError.

    What the archive lacks is sent again.
    """
    transaction = str(report.get("TransactionUID") or "")
    kept = {str(item.ReferencedSOPInstanceUID) for item in report.get("ReferencedSOPSequence") or ()}
    failed = {
        str(item.ReferencedSOPInstanceUID): int(item.get("FailureReason") or 0)
        for item in report.get("FailedSOPSequence") or ()
    }
    now = clock()
    with database.session() as session:
        mine = sa.and_(DicomSet.transaction_uid == transaction, DicomSet.state == "sent")
        locked = sa.update(DicomSet).where(mine).values(transaction_uid=transaction).returning(DicomSet.id)
        set_id = session.execute(locked, execution_options=_PLAIN).scalar() if transaction else None
        if set_id is None:
            return False
        row = session.get_one(DicomSet, set_id, populate_existing=True)
        instances = session.scalars(
            sa.select(DicomInstance).where(DicomInstance.set_id == set_id, DicomInstance.state == "sent")
        )
        for instance in instances:
            uid = instance.sop_instance_uid
            if uid in failed:
                instance.state, instance.reason = "waiting", f"not_committed_{failed[uid]:04x}"
                # It need not be asked whether it has it: it said that it has not.
                instance.attempts = 0 if failed[uid] == NO_SUCH_INSTANCE else instance.attempts
            elif uid in kept:
                instance.state, instance.reason = "committed", None
        session.flush()
        left = set(session.scalars(sa.select(DicomInstance.state).where(DicomInstance.set_id == set_id)))
        row.transaction_uid, row.attempts = None, 0
        if "waiting" in left:
            row.state, row.next_at, row.reason = "waiting", now, "not_committed"
            row.settled_at = None
        elif left == {"committed"}:
            row.state, row.reason, row.settled_at = "committed", None, now
        claim = Claim(row.id, row.cloud_id, row.options, row.study_version, row.state, 0, AUTOMATIC, row.reason)
    if claim.state == "committed":
        note_end(database, claim, "committed", None)
    logger().info("archive has answered for a set", set=claim.set_id, state=claim.state)
    return True
