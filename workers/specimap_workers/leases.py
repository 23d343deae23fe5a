"""Leases: each worker renews its own every other second; the work of one that stops doing so goes to others.

Lives and deaths are judged by the database's clock. A wrong judgement costs a stage run twice, never a job: the engine
and the jobs' rows refuse what a worker writes that has lost its lease.
"""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable

import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.database import Database, database_seconds
from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.logs import logger
from specimap_infra.tables import Lease

LOOKING = 4
"""How many workers, of any number, look after the others in the time of one heartbeat."""


class LeaseKeeper:
    """Renews one worker's lease in a thread, and looks after others.

    At a heartbeat ``look_after`` gets the executors that live, or None while it is too early to judge others by their
    leases; ``settle`` is called once a lease; ``beat`` at every heartbeat, also while the database is away. Of many
    workers only some look after others at a time: what one finds grows with their number, so what all find would grow
    with its square.
    """

    def __init__(
        self,
        database: Database,
        executor: str,
        *,
        kind: str,
        heartbeat_seconds: float,
        lease_seconds: float,
        look_after: Callable[[set[str] | None], None],
        settle: Callable[[], None],
        beat: Callable[[], None] = lambda: None,
    ) -> None:
        self._database = database
        self._executor = executor
        self._host = executor.split(":", 1)[0]
        self._kind = kind
        self._heartbeat = heartbeat_seconds
        self._ttl = lease_seconds
        self._look_after = look_after
        self._settle = settle
        self._beat = beat
        self._leased = False
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="lease", daemon=True)

    def start(self) -> None:
        """Take the lease, then keep it. Raises DatabaseUnavailableError."""
        self._renew()
        self._thread.start()

    def stop(self) -> None:
        """Give the lease back."""
        self._stop.set()
        self._thread.join(timeout=10)
        try:
            with self._database.session() as session:
                session.execute(sa.delete(Lease).where(Lease.executor == self._executor))
        except DatabaseUnavailableError:
            logger().warning("lease not given back: the database is away", executor=self._executor)

    def _run(self) -> None:
        steady: float | None = None
        renewed = settled = time.monotonic()
        while not self._stop.wait(self._heartbeat):
            try:
                self._beat()
                self._renew()
                now = time.monotonic()
                # After an outage or a freeze the others may not have had their turn yet: wait a lease before judging.
                if steady is None or now - renewed > self._ttl:
                    steady = now
                renewed = now
                if now - steady < self._ttl:
                    self._look_after(None)
                    continue
                living = self._living()
                if random.random() * len(living) > LOOKING:  # noqa: S311 - spreads work, keeps no secret
                    continue
                self._look_after(living)
                if now - settled >= self._ttl:
                    settled = now
                    self._settle()
            except DatabaseUnavailableError:
                # The log tells once that it is away.
                steady = None
            except Exception:
                # This thread must outlive any error: without it the worker would count as dead.
                logger().exception("looking after others failed", executor=self._executor)

    def _renew(self) -> None:
        now = database_seconds(self._database.engine)
        values = {"executor": self._executor, "host": self._host, "kind": self._kind, "started": now, "heartbeat": now}
        with self._database.session() as session:
            renewed = sa.update(Lease).where(Lease.executor == self._executor).values(heartbeat=now)
            if session.execute(renewed.returning(Lease.executor)).first() is None:
                session.execute(sa.insert(Lease).values(**values))
                if self._leased:
                    # Others took this worker for dead. It lives, so its jobs did not kill it.
                    jobs.take_back(session, self._executor)
        self._leased = True

    def _living(self) -> set[str]:
        """Executors whose lease is live; the others' leases are removed."""
        oldest = database_seconds(self._database.engine) - self._ttl
        with self._database.session() as session:
            gone = session.execute(sa.delete(Lease).where(Lease.heartbeat < oldest).returning(Lease.executor)).scalars()
            for executor in gone:
                logger().warning("worker is silent: its work goes to others", executor=executor)
            return set(session.scalars(sa.select(Lease.executor)))
