"""Locks of uploads in the database, for API processes of several machines: one request at a time writes to an upload.

A lock is held until a time by the database's clock, and renewed while its process lives; one that a killed process
left is free some seconds later. Whoever lost a lock without knowing is refused by the row: each write names its holder.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass

import sqlalchemy as sa

from specimap_core.errors import SpecimapError
from specimap_infra.database import Database, database_seconds
from specimap_infra.tables import Upload
from specimap_service.auth.access import no_upload

HOLD_SECONDS = 5.0
"""How long a lock outlives its last renewal."""
RENEW_SECONDS = 1.0
WANTED_SECONDS = 2 * RENEW_SECONDS
"""How long a lock counts as wanted after another request asked for it."""


@dataclass(frozen=True)
class Held:
    """A lock, and the bytes that the upload had when it was taken."""

    upload_id: str
    holder: str
    received: int


class UploadLocks:
    """Locks of one process. Safe to share between threads."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._changed = threading.Condition()
        self._held: dict[str, Callable[[], None]] = {}
        """By holder: what to call when another request wants the lock."""
        self._released: set[str] = set()
        self._keeper: threading.Thread | None = None

    def take(self, upload_id: str) -> Held | None:
        """Take the lock of an unfinished upload; None where it is held. Raises NotFoundError."""
        now = database_seconds(self._database.engine)
        holder = uuid.uuid4().hex
        free = sa.and_(Upload.id == upload_id, Upload.state == "open", Upload.held_until < now)
        with self._database.session() as session:
            received = session.scalar(
                sa.update(Upload)
                .where(free)
                .values(holder=holder, held_until=now + HOLD_SECONDS, wanted_at=0.0)
                .returning(Upload.received),
                execution_options={"synchronize_session": False},
            )
            if received is None:
                if session.scalar(sa.select(Upload.state).where(Upload.id == upload_id)) != "open":
                    raise no_upload()
                session.execute(
                    sa.update(Upload)
                    .where(Upload.id == upload_id, Upload.wanted_at < now - RENEW_SECONDS / 2)
                    .values(wanted_at=now),
                    execution_options={"synchronize_session": False},
                )
                return None
        with self._changed:
            self._held[holder] = _nothing
            self._wake()
        return Held(upload_id, holder, received)

    def when_wanted(self, held: Held, call: Callable[[], None]) -> None:
        """Call ``call`` now and then, from another thread, while a request waits for the lock."""
        with self._changed:
            if held.holder in self._held:
                self._held[held.holder] = call

    def release(self, held: Held) -> None:
        """Give the lock back; does not wait for the database."""
        with self._changed:
            self._held.pop(held.holder, None)
            self._released.add(held.holder)
            self._wake()

    def _wake(self) -> None:
        if self._keeper is None:
            self._keeper = threading.Thread(target=self._keep, name="upload locks", daemon=True)
            self._keeper.start()
        self._changed.notify_all()

    def _keep(self) -> None:
        """Renew and give back, as long as there is anything to do."""
        while True:
            with self._changed:
                if not self._released:
                    self._changed.wait(RENEW_SECONDS)
                released, self._released = self._released, set()
                held = dict(self._held)
                if not released and not held:
                    self._keeper = None
                    return
            try:
                wanted = self._renew(set(held), released)
            except SpecimapError:
                # The database is away: whoever holds a lock finds out at the next write.
                with self._changed:
                    self._released |= released
                time.sleep(RENEW_SECONDS)
                continue
            for holder in wanted:
                held[holder]()

    def _renew(self, held: set[str], released: set[str]) -> list[str]:
        """Renew and give back locks; return the holders of those that others want."""
        now = database_seconds(self._database.engine)
        options = {"synchronize_session": False}
        with self._database.session() as session:
            if released:
                given = sa.update(Upload).where(Upload.holder.in_(released)).values(holder=None, held_until=0.0)
                session.execute(given, execution_options=options)
            if not held:
                return []
            wanted = (Upload.wanted_at > now - WANTED_SECONDS).label("wanted")
            renewed = sa.update(Upload).where(Upload.holder.in_(held)).values(held_until=now + HOLD_SECONDS)
            rows = session.execute(renewed.returning(Upload.holder, wanted), execution_options=options)
            return [str(holder) for holder, is_wanted in rows if is_wanted]


def _nothing() -> None:
    """Nobody gives way."""
