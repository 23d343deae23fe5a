"""What the requests share: settings, database, storage, queue client; made when the app is created."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import structlog
from dbos import DBOSClient
from fastapi import Depends, Request
from sqlalchemy.orm import Session

from specimap.infra.database import Database
from specimap.infra.models import AuditEntry
from specimap.infra.queue import queue_client
from specimap.infra.settings import ServiceSettings
from specimap.infra.storage import Storage
from specimap.service.clouds import OpenClouds
from specimap.service.job_events import JobEvents
from specimap.service.judging import Judge
from specimap.service.limits import RateLimiter
from specimap.service.metrics import Metrics
from specimap.service.picture_cache import PictureCache


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
            Judge(settings),
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
