"""What the requests share: settings, database, storage, queue client; made when the app is created."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Annotated

import structlog
from dbos import DBOSClient
from fastapi import Depends, Request
from sqlalchemy.orm import Session

from specimap_infra.database import Database
from specimap_infra.queue import queue_client
from specimap_infra.settings import ServiceSettings
from specimap_infra.storage import Storage
from specimap_infra.tables import AuditEntry
from specimap_service.acquisitions.judge import Judge
from specimap_service.auth.rate_limit import RateLimiter
from specimap_service.clouds.open_clouds import OpenClouds
from specimap_service.clouds.picture_cache import PictureCache
from specimap_service.jobs.events import JobEvents
from specimap_service.metrics import Metrics


@dataclass(frozen=True)
class AppContext:
    """One for each app."""

    settings: ServiceSettings
    database: Database
    storage: Storage
    queue: DBOSClient
    limiter: RateLimiter
    metrics: Metrics
    clouds: OpenClouds
    judge: Judge
    events: JobEvents
    pictures: PictureCache

    @classmethod
    def open(cls, settings: ServiceSettings) -> AppContext:
        """Open everything; connections are made on first use.

        Raises:
            SettingsError, OutputNotWritableError: the storage or its folder cannot be made.
        """
        database = Database.open(settings.database)
        storage = Storage.open(settings)
        return cls(
            settings,
            database,
            storage,
            queue_client(database.engine),
            RateLimiter(),
            Metrics(database, storage),
            OpenClouds(storage, database),
            Judge(settings, os.environ),
            JobEvents(database),
            PictureCache(),
        )

    def close(self) -> None:
        """Stop the judging process and close the connections."""
        self.judge.close()
        self.queue.destroy()
        self.database.close()


async def app_context(request: Request) -> AppContext:
    """The app's context; ``async`` so that no thread is taken for it."""
    context: AppContext = request.app.state.context
    return context


Context = Annotated[AppContext, Depends(app_context)]


def correlation_id() -> str:
    """The id that stands in every log line, error and row that belong to the current request."""
    return str(structlog.contextvars.get_contextvars().get("correlation_id", ""))


def audit(session: Session, key_id: str, action: str, target: str, **details: object) -> None:
    """Note who did what, within the transaction that does it. ``details`` hold ids and numbers, no names."""
    session.add(
        AuditEntry(key_id=key_id, action=action, target=target, details=details, correlation_id=correlation_id())
    )
