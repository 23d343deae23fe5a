"""Forwards the audit trail to a syslog server, each entry at least once, across outages and restarts."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa

from specimap_core.errors import SpecimapError
from specimap_hospital.audit.messages import Source, dicom_message, json_line
from specimap_hospital.audit.reading import BATCH, sealed_after
from specimap_hospital.audit.syslog import Message, Server
from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.sealing import seal
from specimap_infra.database import Database, rows_changed, utc_now
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import AuditCursor

DICOM_KIND, JSON_KIND = "DICOM+RFC3881", "SPECIMAP+JSON"
"""MSGID; the first one is DICOM's own."""
IDLE_SECONDS = 1.0
LONGEST_PAUSE_SECONDS = 60.0


class AuditForwarder:
    """Sends what follows the cursor in the database, and moves the cursor once the server has read it."""

    def __init__(self, database: Database, settings: ServiceSettings) -> None:
        self._database = database
        self._keys = ChainKeys.of(settings)
        self._destination = settings.audit_syslog
        self._server = Server(settings.audit_syslog, settings.audit_syslog_ca, settings.audit_syslog_certificate)
        self._as_dicom = settings.audit_syslog_format == "dicom"
        self._source = Source(settings.audit_source, settings.audit_site)

    def step(self) -> int:
        """Send the next entries; return how many.

        Raises:
            SyslogUnavailableError, SettingsError: they were not sent; the next call sends them again.
            DatabaseUnavailableError: the database cannot be reached.
        """
        seal(self._database, self._keys)
        cursor = self._cursor()
        entries = sealed_after(self._database, cursor, BATCH)
        if not entries:
            return 0
        self._server.send([self._message(entry) for entry in entries])
        self._advance(cursor, entries[-1]["seq"])
        return len(entries)

    def run(self, stop: threading.Event) -> None:
        """Send until ``stop`` is set; waits longer from failure to failure, a minute at most."""
        pause = IDLE_SECONDS
        while not stop.is_set():
            try:
                if self.step():
                    pause = IDLE_SECONDS
                    continue
                pause = IDLE_SECONDS
            except SpecimapError as error:
                logger().warning("the audit trail is not forwarded", code=error.code, retry_s=pause)
                pause = min(2 * pause, LONGEST_PAUSE_SECONDS)
            stop.wait(pause)

    def _message(self, entry: Mapping[str, Any]) -> Message:
        if self._as_dicom:
            return Message(entry["at"], DICOM_KIND, dicom_message(entry, self._source))
        return Message(entry["at"], JSON_KIND, json_line(entry))

    def _cursor(self) -> int:
        with self._database.session() as session:
            found = session.get(AuditCursor, self._destination)
            if found is None:
                found = AuditCursor(destination=self._destination, seq=0)
                session.add(found)
            return found.seq

    def _advance(self, before: int, seq: int) -> None:
        # Another forwarder may have sent the same meanwhile: a cursor never goes back.
        moved = sa.update(AuditCursor).where(AuditCursor.destination == self._destination, AuditCursor.seq == before)
        with self._database.session() as session:
            result = session.execute(
                moved.values(seq=seq, updated_at=utc_now()), execution_options={"synchronize_session": False}
            )
            if not rows_changed(result):
                logger().warning("another program forwards the audit trail too")
