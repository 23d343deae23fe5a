"""Objects that all features share: settings, database, storage, queue client, metrics; made when the app is created."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import structlog
from dbos import DBOSClient
from fastapi import Depends
from sqlalchemy.orm import Session

from specimap_infra.database import Database
from specimap_infra.projects import project_of
from specimap_infra.queue import queue_client
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.tables import AuditEntry
from specimap_service.app_state import AppState
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

    @classmethod
    def open(cls, settings: ServiceSettings) -> AppContext:
        """Open everything; connections are made on first use.

        Raises:
            SettingsError, OutputNotWritableError: the storage or its folder cannot be made.
        """
        database = Database.open(settings.database)
        storage = Storage.open(settings)
        return cls(settings, database, storage, queue_client(database.engine), Metrics(database, storage, settings))

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
    project = project_of(session, target)
    if project is None:
        raise LookupError(f"{target} is not there to be written about")
    session.add(
        AuditEntry(
            key_id=key_id,
            project_id=project,
            action=action,
            target=target,
            details=details,
            correlation_id=correlation_id(),
        )
    )
