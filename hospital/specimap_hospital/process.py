"""The process of the hospital's side: sends what waits, and listens to the DICOM port. It ends when it is told to."""

from __future__ import annotations

import os
import socket
import threading
import time
import uuid
from collections.abc import Callable

from specimap_core.errors import SpecimapError
from specimap_hospital.fhir.client import FhirClient
from specimap_hospital.fhir.delivery import FhirSender
from specimap_hospital.fhir.notices import add_notices
from specimap_hospital.fhir.result import bundle_maker
from specimap_hospital.outbox.sender import Sender
from specimap_hospital.outbox.workspaces import sweep
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.heartbeats import Note
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage

POLL_SECONDS = 2.0
"""How often it looks for what has to be sent."""
AWAY_SECONDS = 5.0
SWEEP_SECONDS = 3600.0
STOP_SECONDS = 10.0
NOTES = "hospital"
"""Folder in the scratch folder with the notes of these processes (:mod:`specimap_infra.heartbeats`)."""
SILENT_SECONDS = 1800.0
"""Time without a beat from which a process hangs: the making of one set takes at most half of it."""


class HospitalProcess:
    """Runs until :meth:`stop`: a database, a storage or an archive that is away is waited for."""

    def __init__(self, settings: ServiceSettings) -> None:
        """Raises SettingsError, OutputNotWritableError: the storage or its folder cannot be made."""
        self._settings = settings
        self._database = Database.open(settings.database)
        self._storage = Storage.open(settings)
        self._sender = Sender(self._database, self._storage, settings)
        self._stop = threading.Event()
        self._fhir = self._fhir_sender() if settings.fhir_url else None
        self._forwarder = threading.Thread(target=self._forward, name="audit forwarder", daemon=True)

    def stop(self) -> None:
        """End soon: after the object that is being sent."""
        self._stop.set()
        self._sender.stop()

    def run(self) -> None:
        """Work until stopped."""
        note = Note.leave(self._settings.scratch / NOTES, uuid.uuid4().hex, f"{socket.gethostname()}:{os.getpid()}")
        listener = self._listener()
        swept = -SWEEP_SECONDS
        if self._settings.audit_syslog:
            self._forwarder.start()
        try:
            while not self._stop.is_set():
                note.beat()
                if time.monotonic() - swept > SWEEP_SECONDS:
                    swept = time.monotonic()
                    self._patiently(lambda: sweep(self._settings.scratch) > 0)
                waits = [self._patiently(step) for step in (self._send, self._tell)]
                self._stop.wait(min(waits))
        finally:
            listener()
            if self._forwarder.is_alive():
                self._forwarder.join(STOP_SECONDS)
            note.close()
            self._database.close()

    def _forward(self) -> None:
        """Forward the audit trail, in a thread of its own: objects take minutes to send."""
        from specimap_hospital.audit.forwarder import AuditForwarder

        while not self._stop.is_set():
            try:
                AuditForwarder(self._database, self._settings).run(self._stop)
            except Exception as error:
                logger().error("the audit trail is not forwarded", error=type(error).__name__)
                self._stop.wait(AWAY_SECONDS)

    def _send(self) -> bool:
        if not self._settings.sends_dicom:
            return False
        self._sender.add()
        return self._sender.work()

    def _tell(self) -> bool:
        if self._fhir is None:
            return False
        add_notices(self._database, utc_now(), archived=self._settings.sends_dicom)
        return self._fhir.step() > 0

    def _fhir_sender(self) -> FhirSender:
        make = bundle_maker(self._database, self._storage, self._settings, self._stop.is_set)
        client = FhirClient(self._settings)
        return FhirSender(self._database, client, make, attempts=self._settings.fhir_attempts)

    def _patiently(self, step: Callable[[], bool]) -> float:
        """Do a step; return how long to wait before the next. Nothing that it meets ends the process."""
        try:
            return 0.0 if step() else POLL_SECONDS
        except DatabaseUnavailableError:
            pass  # the log tells once that it is away
        except SpecimapError as error:
            logger().error("hospital process failed", code=error.code)
        except Exception as error:
            # Without its text, which may hold a value of a DICOM object.
            logger().error("hospital process failed", error=type(error).__name__)
        return AWAY_SECONDS

    def _listener(self) -> Callable[[], None]:
        if not self._settings.dicom_port:
            return lambda: None
        from specimap_hospital.receive.listener import start_listener

        return start_listener(self._database, self._settings)
