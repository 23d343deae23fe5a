"""Events of jobs for many listeners, with one query to the database for all of them.

PostgreSQL notifies of new events. SQLite is asked four times a second, and so is PostgreSQL while nobody can listen.
"""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import AsyncGenerator, Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import Database
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.logs import logger
from specimap_infra.notifications import JOB_EVENTS, Listener
from specimap_infra.queue import POLL_SECONDS, QUIET_SECONDS
from specimap_infra.tables import FINAL_STATES, Job, JobEvent
from specimap_service.errors import RateLimitedError

PAUSE_SECONDS = 0.01
"""Pause after a notification, for others to come: a look finds what all of them tell of."""
KEEP_ALIVE_SECONDS = 15.0
RETRY_SECONDS = 1.0
"""How long to wait before a database that did not answer is queried again."""
RETRY_AFTER_SECONDS = 5
PAGE = 500
KEPT = 512
"""Events of a job that are kept for its listeners; a listener further behind reads the database."""

Check = Callable[[], Awaitable[float | None]]
"""Tells a stream for how many seconds it may go on before it is called again; None: no longer."""


@dataclass(frozen=True)
class Event:
    """An event of a job; ``seq`` counts from 1 without a gap."""

    seq: int
    type: str
    data: dict[str, Any]

    @property
    def final(self) -> bool:
        """Whether no event comes after it."""
        return self.type == "state" and self.data["state"] in FINAL_STATES


@dataclass
class _Channel:
    """A job with listeners: its newest events, and a signal when there are more."""

    head: int
    recent: deque[Event] = field(default_factory=lambda: deque(maxlen=KEPT))
    listeners: int = 0
    changed: asyncio.Event = field(default_factory=asyncio.Event)

    def add(self, events: list[Event]) -> None:
        self.recent.extend(events)
        self.head = events[-1].seq
        # Each waiter holds the old event; the next ones wait for the new.
        self.changed.set()
        self.changed = asyncio.Event()

    def after(self, seq: int) -> list[Event] | None:
        """Return the events after ``seq``; None where they are no longer kept."""
        if seq >= self.head:
            return []
        if not self.recent or self.recent[0].seq > seq + 1:
            return None
        return [event for event in self.recent if event.seq > seq]


class Streams:
    """How many streams each key follows, in this process."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._counts: Counter[str] = Counter()

    @contextmanager
    def place(self, key_id: str) -> Iterator[None]:
        """Hold one of the key's places. Raises RateLimitedError."""
        if self._counts[key_id] >= self._most:
            raise RateLimitedError(
                f"The key follows {self._most} streams of events already.",
                advice="End one of them; one stream is enough for each job.",
                retry_after_s=RETRY_AFTER_SECONDS,
            )
        self._counts[key_id] += 1
        try:
            yield
        finally:
            self._counts[key_id] -= 1
            if not self._counts[key_id]:
                del self._counts[key_id]


class JobEvents:
    """Events by job. Used on one event loop; the database is read in threads, and no connection waits."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._channels: dict[str, _Channel] = {}
        self._poller: asyncio.Task[None] | None = None
        self._listener = Listener(database, (JOB_EVENTS,), self._told)
        self._loop: asyncio.AbstractEventLoop | None = None
        self._wanted: set[str] = set()
        """Jobs to look at before the next poll."""
        self._look = asyncio.Event()

    def start(self) -> None:
        """Listen to notifications, where there are any; from the event loop."""
        self._loop = asyncio.get_running_loop()
        self._listener.start()

    def stop(self) -> None:
        """End listening; from a thread."""
        self._listener.stop()

    def _told(self, _: str, job_id: str) -> None:
        """Pass a notification on to the event loop, from the listener's thread."""
        if self._loop is not None:
            with suppress(RuntimeError):  # the loop has ended
                self._loop.call_soon_threadsafe(self._want, job_id)

    def _want(self, job_id: str) -> None:
        """Look at a job that has listeners before the next poll; at all of them where the id is empty."""
        if job_id in self._channels:
            self._wanted.add(job_id)
        elif not job_id:
            self._wanted |= set(self._channels)
        if self._wanted:
            self._look.set()

    async def follow(self, job_id: str, after: int, check: Check) -> AsyncGenerator[Event | None]:
        """Yield events after number ``after`` as they occur, and None now and then while nothing happens.

        Ends after the final event, when the job is deleted, or when ``check`` says so. Waits while the database is
        unavailable. ``after`` is not beyond the job's last event: all its listeners share one position.
        """
        clock = asyncio.get_running_loop().time
        with self._listening(job_id, after) as channel:
            seq, told, due = after, clock(), clock()
            while True:
                if clock() >= due:
                    seconds = await check()
                    if seconds is None:
                        return
                    due = clock() + seconds
                changed = channel.changed
                events = channel.after(seq)
                if events is None:
                    try:
                        found = await asyncio.to_thread(read_events, self._database, {job_id: seq})
                    except DatabaseUnavailableError:
                        yield None
                        await asyncio.sleep(RETRY_SECONDS)
                        continue
                    events = found.get(job_id, [])
                for event in events:
                    yield event
                    seq = event.seq
                    if event.final:
                        return
                if events:
                    told = clock()
                    continue
                alive = told + KEEP_ALIVE_SECONDS
                with suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), max(0.0, min(due, alive) - clock()))
                    continue
                if clock() >= alive:
                    if await self._over(job_id, seq):
                        return
                    told = clock()
                    yield None

    @contextmanager
    def _listening(self, job_id: str, after: int) -> Iterator[_Channel]:
        if job_id not in self._channels:
            self._channels[job_id] = _Channel(after)
            self._want(job_id)
        channel = self._channels[job_id]
        channel.listeners += 1
        if self._poller is None or self._poller.done():
            self._poller = asyncio.create_task(self._poll())
        try:
            yield channel
        finally:
            channel.listeners -= 1
            if not channel.listeners:
                del self._channels[job_id]

    async def _poll(self) -> None:
        clock = asyncio.get_running_loop().time
        looked_at_all = -QUIET_SECONDS
        while self._channels:
            # Before the look: what is told of during it may be too late for it.
            wanted, self._wanted = self._wanted, set()
            self._look.clear()
            if not wanted or clock() - looked_at_all >= QUIET_SECONDS:
                wanted, looked_at_all = set(self._channels), clock()
            heads = {job_id: channel.head for job_id, channel in self._channels.items() if job_id in wanted}
            found: dict[str, list[Event]] = {}
            wait = QUIET_SECONDS if self._listener.listening else POLL_SECONDS
            try:
                found = await asyncio.to_thread(read_events, self._database, heads)
            except DatabaseUnavailableError:
                wait = RETRY_SECONDS
            except Exception:
                # Whatever the error, the listeners of all jobs depend on this task.
                logger().exception("reading of job events failed")
                wait = RETRY_SECONDS
            for job_id, events in found.items():
                channel = self._channels.get(job_id)
                # A channel that was closed and opened again meanwhile may be at another event.
                if channel is not None and channel.head == heads[job_id]:
                    channel.add(events)
            if sum(map(len, found.values())) < PAGE:
                await self._wait(wait)

    async def _wait(self, seconds: float) -> None:
        """Wait, but only until there is a job to look at."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._look.wait(), seconds)
            await asyncio.sleep(PAUSE_SECONDS)

    async def _over(self, job_id: str, seq: int) -> bool:
        """Return whether no event can come after number ``seq``."""

        def find() -> bool:
            with self._database.session() as session:
                job = session.get(Job, job_id)
                return job is None or position(session, job, seq) is None

        try:
            return await asyncio.to_thread(find)
        except DatabaseUnavailableError:
            return False


def position(session: Session, job: Job, seen: int) -> int | None:
    """Return the number after which a listener follows a job; None where nothing comes after the last event seen.

    It is the number of the last event that there is, where the one that was seen is beyond it.
    """
    last = sa.select(sa.func.max(JobEvent.seq)).where(JobEvent.job_id == job.id)
    found = session.scalar(last) or 0
    # The state after the events: the final event of a job that goes on has a higher number.
    session.refresh(job)
    if job.state in FINAL_STATES and seen >= (session.scalar(last) or 0):
        return None
    return min(seen, found)


def read_events(database: Database, after: dict[str, int]) -> dict[str, list[Event]]:
    """Return the next events of each job after a number, at most 500 in all; jobs without any are left out.

    Raises:
        DatabaseUnavailableError: the database cannot be reached.
    """
    found: dict[str, list[Event]] = {}
    if not after:
        return found
    wanted = sa.or_(*(sa.and_(JobEvent.job_id == job_id, JobEvent.seq > seq) for job_id, seq in after.items()))
    query = sa.select(JobEvent.job_id, JobEvent.seq, JobEvent.type, JobEvent.data).where(wanted)
    with database.session() as session:
        for job_id, seq, type, data in session.execute(query.order_by(JobEvent.job_id, JobEvent.seq).limit(PAGE)):
            found.setdefault(job_id, []).append(Event(seq, type, data))
    return found
