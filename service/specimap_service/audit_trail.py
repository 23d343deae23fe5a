"""Reads and refusals of the audit trail: collected in memory, and written in batches by a thread.

A read waits for no disk. Its entry is in the database after :data:`FLUSH_SECONDS`, and sealed with the next round; only
a process that is killed loses what it answered in that time. Nothing is dropped: where the database does not take the
entries, requests first wait for room, and are refused after :data:`PATIENCE_SECONDS`.

The first request of a kind is an entry at once. Like ones, of the same actor on the same object, are counted, and
become one more entry at the end of the interval: thousands of chunks of a cloud are two entries a minute. Refusals are
bounded in the same way, also where each names another object.
"""

from __future__ import annotations

import datetime
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import anyio
import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import SpecimapError
from specimap_infra.audit.entries import Addresses
from specimap_infra.audit.records import ChainKeys
from specimap_infra.audit.sealing import seal
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.logs import logger
from specimap_infra.projects import acquisition_of, project_of
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import AuditEntry

FLUSH_SECONDS = 0.5
"""How long an entry may wait in memory: what a killed process may lose."""
MOST_WAITING = 5000
"""Entries in memory from which on requests wait."""
BATCH = 500
PATIENCE_SECONDS = 10.0
"""How long a request waits for room before it is refused."""
INTERVAL_SECONDS = 60.0
"""How long like requests are counted together."""
MOST_KINDS = 20_000
"""Kinds of requests that are counted at a time; beyond, those of one address count as one kind."""
MOST_REFUSED = 30
"""Different refused requests of an actor and address in an interval that are told apart."""
SEVERAL = "several"
"""Action of an entry that stands for refused requests of several kinds."""
STOP_SECONDS = 5.0
AWAY_SECONDS = 1.0
"""Pause after the database did not take the entries."""


@dataclass(frozen=True)
class Access:
    """A request as the trail tells of it; like ones are equal."""

    actor: str
    session_id: str
    project_id: str
    action: str
    target: str
    outcome: str
    status: int
    address: str


@dataclass
class _Counted:
    until: float
    count: int = 0
    since: datetime.datetime = field(default_factory=utc_now)
    correlation_id: str = ""


class AuditTrail:
    """Collects requests, writes and seals entries. Safe to share between threads."""

    def __init__(self, database: Database, settings: ServiceSettings) -> None:
        self._database = database
        self._keys = ChainKeys.of(settings)
        self.addresses = Addresses(database, settings)
        self._lock = threading.Lock()
        self._waiting: list[dict[str, Any]] = []
        self._kinds: dict[Access, _Counted] = {}
        self._refused: Counter[tuple[str, str]] = Counter()
        self._refused_until = 0.0
        self._wake, self._stop = threading.Event(), threading.Event()
        self._flushing = threading.Lock()
        self._away = False
        """Whether the log has told that the database is away."""
        self._thread = threading.Thread(target=self._run, name="audit", daemon=True)

    # ---- requests ---------------------------------------------------------------------------------------

    async def room(self) -> None:
        """Wait until there is room for the entry of a request.

        Raises:
            DatabaseUnavailableError: there was none for long.
        """
        deadline = time.monotonic() + PATIENCE_SECONDS
        while len(self._waiting) >= MOST_WAITING:
            self._wake.set()
            if time.monotonic() > deadline:
                raise DatabaseUnavailableError(
                    "The audit trail cannot be written, so the request is not answered.",
                    advice="Try again in some seconds.",
                )
            await anyio.sleep(0.02)

    def record(self, access: Access, correlation_id: str) -> None:
        """Take note of a request that was answered; costs no query."""
        now = time.monotonic()
        with self._lock:
            access = self._bounded(access, now)
            found = self._kinds.get(access)
            if found is not None and now < found.until:
                found.count += 1
                found.correlation_id = correlation_id
                return
            if found is not None:
                self._add_counted(access, found)
            self._kinds[access] = _Counted(now + INTERVAL_SECONDS)
            self._add(access, correlation_id, 1, {})
            if len(self._waiting) >= BATCH:
                self._wake.set()

    def _bounded(self, access: Access, now: float) -> Access:
        if access.status in (401, 403, 404):
            if now >= self._refused_until:
                self._refused.clear()
                self._refused_until = now + INTERVAL_SECONDS
            if access not in self._kinds:
                who = access.actor, access.address
                told_apart = who in self._refused or len(self._refused) < MOST_KINDS
                if told_apart:
                    self._refused[who] += 1
                if not told_apart or self._refused[who] > MOST_REFUSED:
                    access = Access(
                        access.actor, "", access.project_id, SEVERAL, "", access.outcome, access.status, access.address
                    )
        if access not in self._kinds and len(self._kinds) >= MOST_KINDS:
            # The last resort, for a flood from more addresses than can be told apart.
            access = Access("", "", "", SEVERAL, "", access.outcome, access.status, "")
        return access

    def _add(self, access: Access, correlation_id: str, count: int, details: dict[str, Any]) -> None:
        if access.session_id:
            details = {**details, "session": access.session_id[:12]}
        self._waiting.append(
            {
                "at": utc_now(),
                "key_id": access.actor,
                "project_id": access.project_id,
                "action": access.action,
                "target": access.target,
                "details": details,
                "correlation_id": correlation_id,
                "kind": "access",
                "outcome": access.outcome,
                "status": access.status,
                "acquisition_id": None,
                "address": access.address,
                "count": count,
            }
        )

    def _add_counted(self, access: Access, found: _Counted) -> None:
        if found.count:
            since = found.since.isoformat(timespec="milliseconds")
            self._add(access, found.correlation_id, found.count, {"since": since})

    def service_event(self, action: str) -> None:
        """Take note of a start or an end of the program."""
        with self._lock:
            self._add(Access("service", "", "", action, "service", "success", 0, ""), "", 1, {})
            self._waiting[-1] |= {"kind": "service", "status": None}

    # ---- the thread -------------------------------------------------------------------------------------

    def start(self) -> None:
        """Write and seal from now on."""
        try:
            self.addresses.prepare()
        except SpecimapError as error:
            logger().warning("the audit trail waits", code=error.code)
        self.service_event("service.start")
        self._thread.start()

    def stop(self) -> None:
        """Write and seal what is left, counts too."""
        self.service_event("service.stop")
        self._stop.set()
        self._wake.set()
        self._thread.join(timeout=STOP_SECONDS)

    def _run(self) -> None:
        while not self._stop.is_set():
            self._wake.wait(FLUSH_SECONDS)
            self._wake.clear()
            self._round(everything=False)
        self._round(everything=True)

    def _round(self, *, everything: bool) -> None:
        try:
            self.addresses.prepare()
            self.flush(everything=everything)
            seal(self._database, self._keys)
            self._away = False
        except SpecimapError as error:
            if not self._away:
                logger().warning("the audit trail waits", code=error.code, entries=len(self._waiting))
            self._away = True
            self._stop.wait(AWAY_SECONDS)
        except Exception:
            logger().exception("the audit trail waits", entries=len(self._waiting))
            self._stop.wait(AWAY_SECONDS)

    def flush(self, *, everything: bool = False) -> None:
        """Write what waits, and counts whose interval is over, or all.

        Raises:
            DatabaseUnavailableError: the server cannot be reached; nothing is lost.
        """
        with self._flushing:
            now = time.monotonic()
            with self._lock:
                for access in [a for a, found in self._kinds.items() if everything or now >= found.until]:
                    self._add_counted(access, self._kinds.pop(access))
            while self._waiting:
                some = self._waiting[:BATCH]
                with self._database.session() as session:
                    rows = _owned(session, some)
                    session.execute(sa.insert(AuditEntry), rows)
                with self._lock:
                    del self._waiting[: len(some)]


def _owned(session: Session, entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return entries with the projects and acquisitions of their targets, as far as there are such objects."""
    owners = {
        target: (project_of(session, target), acquisition_of(session, target))
        for target in {entry["target"] for entry in entries}
    }
    return [
        {
            **entry,
            "project_id": owners[entry["target"]][0] or entry["project_id"],
            "acquisition_id": owners[entry["target"]][1],
        }
        for entry in entries
    ]
