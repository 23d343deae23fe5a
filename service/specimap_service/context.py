"""Objects that all features share: settings, database, storage, queue client, metrics; made when the app is created."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import structlog
from dbos import DBOSClient
from fastapi import Depends
from sqlalchemy.orm import Session

from specimap_infra.audit.entries import new_entry
from specimap_infra.database import Database
from specimap_infra.queue import queue_client
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_service.app_state import AppState
from specimap_service.audit_note import NOTE
from specimap_service.audit_trail import AuditTrail
from specimap_service.metrics import Metrics

ANSWER_HEADERS = "specimap.headers"
"""Key under which a request's ASGI scope holds headers for its answer, whatever that will be."""


@dataclass(frozen=True)
class AppContext:
    """Objects that all features share, one set for each app."""

    settings: ServiceSettings
    database: Database
    storage: Storage
    queue: DBOSClient
    metrics: Metrics
    trail: AuditTrail

    @classmethod
    def open(cls, settings: ServiceSettings) -> AppContext:
        """Open everything; connections are made on first use.

        Raises:
            SettingsError, OutputNotWritableError: the storage or its folder cannot be made.
        """
        database = Database.open(settings.database)
        storage = Storage.open(settings)
        metrics = Metrics(database, storage, settings)
        queue = queue_client(database.engine)
        return cls(settings, database, storage, queue, metrics, AuditTrail(database, settings))

    def close(self) -> None:
        """Close the connections."""
        self.queue.destroy()
        self.database.close()


CONTEXT = AppState[AppContext]("context")
Context = Annotated[AppContext, Depends(CONTEXT.of_request)]


def correlation_id() -> str:
    """Return the id in every log line, error and row of the current request."""
    return str(structlog.contextvars.get_contextvars().get("correlation_id", ""))


def audit(session: Session, key_id: str, action: str, target: str, **details: object) -> None:
    """Add an entry to the audit trail within the transaction that it records: before the target is deleted.

    ``details`` hold ids and numbers, no names.
    """
    note = NOTE.get()
    new_entry(
        session,
        key_id,
        action,
        target,
        details,
        correlation_id=correlation_id(),
        address="" if note is None else note.address,
    )
    if note is not None:
        note.written = True
