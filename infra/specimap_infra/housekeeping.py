"""Rules for what grows: how long it is kept, and its removal. docs/hospital-it.md describes them.

Every rule may run in several programs at once, and be stopped anywhere: rows go first, and the files that they referred
to afterwards; what is left then is found by ``specimap storage check``.
"""

from __future__ import annotations

import datetime
import os
import re
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import sqlalchemy as sa
from dbos import DBOSClient
from sqlalchemy.orm import InstrumentedAttribute, Session, aliased

from specimap_core.atomic import remove
from specimap_core.errors import SpecimapError
from specimap_infra.database import Database, rows_changed, utc_now
from specimap_infra.logs import logger
from specimap_infra.schema_version import engine_schema
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import TEMPORARY, Storage
from specimap_infra.tables import (
    FINAL_STATES,
    Acquisition,
    Artefact,
    AuditEntry,
    CloudRow,
    Delivery,
    DicomInstance,
    DicomSet,
    Export,
    Job,
    JobEvent,
    LabelVersion,
    Lease,
    RepeatableRequest,
    SignIn,
    Upload,
)

BATCH = 200
"""Rows, or jobs, of one transaction: others wait for no more than that."""
FIRST_SECONDS = 5.0
EVERY_SECONDS = 3600.0
STOP_SECONDS = 3.0
LEFTOVER_SECONDS = 24 * 3600.0
"""Age from which a file aside belongs to a process that was killed; none works on one for as long."""
LEFTOVER = re.compile(
    r"^(?:[0-9a-f]{32}|dicom-[0-9a-f]{32}|label-[0-9a-f]{32}(?:\.body)?|exp_[\w-]+|restore-[0-9a-f]{32})\.tmp$"
)
"""Names that our programs give in the scratch folder, which may be shared with others."""
AUDITED_AS = "service"
REQUEST_DAYS = 7.0
"""How long a request with an idempotency key may be sent again: longer than a tablet is without a network."""
SESSION_DAYS = 1.0
"""How long the row of a session outlives it."""
ENDED_WORKFLOWS = ["SUCCESS", "ERROR", "CANCELLED", "MAX_RECOVERY_ATTEMPTS_EXCEEDED"]

Batch = Callable[[datetime.datetime], int]
"""Removes some of what is older; returns how many."""


class Housekeeping:
    """The rules with what they work on."""

    def __init__(self, database: Database, storage: Storage, settings: ServiceSettings, queue: DBOSClient) -> None:
        self._database = database
        self._storage = storage
        self._settings = settings
        self._queue = queue
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="housekeeping", daemon=True)

    def start(self) -> None:
        """Apply the rules now and then, in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the batch under way; one that takes long is left to end with the process."""
        self._stop.set()
        self._thread.join(timeout=STOP_SECONDS)

    def _run(self) -> None:
        wait = FIRST_SECONDS
        while not self._stop.wait(wait):
            wait = EVERY_SECONDS
            self.sweep()

    def sweep(self) -> dict[str, int]:
        """Apply every rule once; return what was removed, by rule. Errors are logged, and the next rule applies."""
        s = self._settings
        rules: dict[str, tuple[float, Batch]] = {
            "events": (s.keep_event_days, self._events),
            "workflows": (s.keep_workflow_days, self._workflows),
            "artefacts": (s.keep_artefact_days, self._artefacts),
            "exports": (s.keep_export_days, self._exports),
            "labels": (s.keep_label_versions, self._labels),
            "uploads": (s.keep_upload_days, self._uploads),
            "deliveries": (s.keep_delivery_days, self._deliveries),
            "audit": (s.keep_audit_days, self._audit),
            "dicom": (s.keep_dicom_days, self._dicom),
            "requests": (REQUEST_DAYS, self._requests),
            "sessions": (SESSION_DAYS, self._sessions),
        }
        removed = dict.fromkeys([*rules, "leftovers"], 0)
        for name, (days, batch) in rules.items():
            before = utc_now() - datetime.timedelta(days=days)
            try:
                while days and not self._stop.is_set() and (count := batch(before)):
                    removed[name] += count
            except SpecimapError as error:
                logger().warning("housekeeping failed", rule=name, code=error.code)
            except Exception:
                # What one rule meets must not keep the others from their work.
                logger().exception("housekeeping failed", rule=name)
        try:
            self._assign()
        except SpecimapError as error:
            logger().warning("housekeeping failed", rule="projects", code=error.code)
        removed["leftovers"] = sweep_leftovers(s, self._storage)
        if any(removed.values()):
            logger().info("swept", **removed)
        return removed

    # ---- rows -----------------------------------------------------------------------------------------

    def _assign(self) -> None:
        """Give rows their project that a program of a release before schema 0006 has written since the upgrade."""
        for table in (Job, CloudRow):
            owner = sa.select(Acquisition.project_id).where(Acquisition.id == table.acquisition_id).scalar_subquery()
            with self._database.session() as session:
                session.execute(
                    sa.update(table).where(table.project_id == "").values(project_id=owner),
                    execution_options={"synchronize_session": False},
                )

    def _events(self, before: datetime.datetime) -> int:
        """Progress and log lines of jobs that ended; changes of state stay, and with them the last event."""
        other = sa.and_(JobEvent.job_id == Job.id, JobEvent.type != "state")
        ended = sa.select(Job.id).where(Job.state.in_(FINAL_STATES), Job.finished_at < before)
        with self._database.session() as session:
            ids = session.scalars(ended.where(sa.exists().where(other)).limit(BATCH)).all()
            if not ids:
                return 0
            gone = sa.delete(JobEvent).where(JobEvent.job_id.in_(ids), JobEvent.type != "state")
            return rows_changed(session.execute(gone.execution_options(synchronize_session=False)))

    def _workflows(self, before: datetime.datetime) -> int:
        """The engine's rows of what has ended: status, inputs, steps, streams, notifications."""
        found = self._queue.list_workflows(
            status=ENDED_WORKFLOWS, end_time=before.isoformat(), limit=BATCH, load_input=False, load_output=False
        )
        ids = [workflow.workflow_id for workflow in found]
        with self._database.session() as session:
            # Rows that go on are compared with their workflows.
            open_ids = set(session.scalars(sa.select(Job.id).where(Job.id.in_(ids), Job.state.not_in(FINAL_STATES))))
            open_ids |= set(
                session.scalars(sa.select(Export.id).where(Export.id.in_(ids), Export.state.not_in(FINAL_STATES)))
            )
        ended = [id for id in ids if id not in open_ids]
        if ended:
            self._queue.delete_workflows(ended)
        return len(ended)

    def _uploads(self, before: datetime.datetime) -> int:
        return self._rows(Upload.id, sa.and_(Upload.state != "open", Upload.expires_at < before))

    def _deliveries(self, before: datetime.datetime) -> int:
        return self._rows(Delivery.id, sa.and_(Delivery.state != "pending", Delivery.next_at < before))

    def _dicom(self, before: datetime.datetime) -> int:
        """States of objects whose set has ended. The set stays, so that it is not sent again."""
        ended = sa.select(DicomSet.id).where(DicomSet.settled_at < before)
        return self._rows(DicomInstance.id, DicomInstance.set_id.in_(ended))

    def _audit(self, before: datetime.datetime) -> int:
        return self._rows(AuditEntry.id, AuditEntry.at < before)

    def _requests(self, before: datetime.datetime) -> int:
        """Names of requests that may be sent again no longer."""
        name = RepeatableRequest.key_id, RepeatableRequest.name
        with self._database.session() as session:
            some = sa.select(*name).where(RepeatableRequest.created_at < before).limit(BATCH)
            gone = sa.delete(RepeatableRequest).where(sa.tuple_(*name).in_(some))
            return rows_changed(session.execute(gone.execution_options(synchronize_session=False)))

    def _sessions(self, before: datetime.datetime) -> int:
        return self._rows(SignIn.id, SignIn.expires_at < before)

    def _rows(self, id: InstrumentedAttribute[str] | InstrumentedAttribute[int], rule: sa.ColumnElement[bool]) -> int:
        with self._database.session() as session:
            some = sa.select(id).where(rule).limit(BATCH)
            gone = sa.delete(id.class_).where(id.in_(some))
            return rows_changed(session.execute(gone.execution_options(synchronize_session=False)))

    # ---- rows with files ------------------------------------------------------------------------------

    def _artefacts(self, before: datetime.datetime) -> int:
        """Results of the stages before the last, of acquisitions without a job that goes on or has ended since."""
        busy = sa.exists().where(
            Job.acquisition_id == Artefact.acquisition_id,
            sa.or_(Job.state.not_in(FINAL_STATES), Job.created_at >= before, Job.finished_at >= before),
        )
        with self._database.session() as session:
            rule = sa.and_(Artefact.created_at < before, ~busy)
            rows = session.execute(sa.select(Artefact.id, Artefact.storage_key).where(rule).limit(BATCH)).all()
            session.execute(sa.delete(Artefact).where(Artefact.id.in_([row.id for row in rows])))
        return self._delete([row.storage_key for row in rows])

    def _exports(self, before: datetime.datetime) -> int:
        """Files made on request; the next request makes them again."""
        with self._database.session() as session:
            rule = sa.and_(Export.created_at < before, Export.state.in_(FINAL_STATES))
            ids = session.scalars(sa.select(Export.id).where(rule).limit(BATCH)).all()
            session.execute(sa.delete(Export).where(Export.id.in_(ids)))
        return self._delete([f"exports/{id}" for id in ids])

    def _labels(self, _: datetime.datetime) -> int:
        """Versions of label layers beyond the newest; an entry of the audit trail tells of them."""
        later = aliased(LabelVersion)
        newer = (
            sa.select(sa.func.count())
            .where(
                later.cloud_id == LabelVersion.cloud_id,
                later.name == LabelVersion.name,
                later.version > LabelVersion.version,
            )
            .scalar_subquery()
        )
        query = (
            sa.select(LabelVersion, Acquisition.project_id)
            .join(CloudRow, CloudRow.id == LabelVersion.cloud_id)
            .join(Acquisition, Acquisition.id == CloudRow.acquisition_id)
            .where(newer >= self._settings.keep_label_versions)
            .limit(BATCH)
        )
        with self._database.session() as session:
            rows = session.execute(query).all()
            for label, project in rows:
                details = {"layer": label.name, "version": label.version}
                session.add(
                    AuditEntry(
                        key_id=AUDITED_AS,
                        project_id=project,
                        action="label.expire",
                        target=label.cloud_id,
                        details=details,
                        correlation_id="",
                    )
                )
                session.delete(label)
            prefixes = [label.storage_prefix for label, _ in rows]
        return self._delete(prefixes)

    def _delete(self, keys: list[str]) -> int:
        for key in keys:
            self._storage.delete(key)
        return len(keys)


def count_rows(session: Session) -> dict[str, int]:
    """Count the rows of what is kept by rule, and of leases."""
    tables: dict[str, sa.FromClause] = {
        "artefacts": Artefact.__table__,
        "audit": AuditEntry.__table__,
        "deliveries": Delivery.__table__,
        "dicom": DicomInstance.__table__,
        "events": JobEvent.__table__,
        "exports": Export.__table__,
        "labels": LabelVersion.__table__,
        "leases": Lease.__table__,
        "requests": RepeatableRequest.__table__,
        "sessions": SignIn.__table__,
        "uploads": Upload.__table__,
        "workflows": sa.table("workflow_status", schema=engine_schema(session.get_bind().dialect)),
    }
    return {name: session.scalar(sa.select(sa.func.count()).select_from(table)) or 0 for name, table in tables.items()}


def scratch_bytes(settings: ServiceSettings) -> int:
    """Add up what lies in the scratch folder of this machine."""
    total = 0
    for folder, _, names in os.walk(settings.scratch):
        for name in names:
            with suppress(OSError):
                total += os.lstat(os.path.join(folder, name)).st_size
    return total


def sweep_leftovers(settings: ServiceSettings, storage: Storage) -> int:
    """Remove what killed processes left aside, in the scratch folder of this machine and in a local storage."""
    found = [path for path in _entries(settings.scratch) if LEFTOVER.match(path.name)]
    if storage.folder is not None:
        found += _entries(storage.folder / TEMPORARY)
    gone = 0
    for path in found:
        with suppress(OSError):
            if time.time() - _last_change(path) > LEFTOVER_SECONDS:
                remove(path)
                gone += 1
    return gone


def _entries(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _last_change(path: Path) -> float:
    """Seconds of the last change to a file, or to anything in a folder."""
    inside = path.rglob("*") if path.is_dir() and not path.is_symlink() else ()
    return max(float(part.lstat().st_ctime) for part in (path, *inside))
