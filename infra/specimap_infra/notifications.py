"""Notifications of PostgreSQL: who waits for work or for events hears of them at once, and asks seldom.

They say that there is something to look for, nothing more: one that is lost is made up for by the next look. They are
sent after the commit of what they tell of, in a transaction of their own that waits for no disk: PostgreSQL lets one
transaction with a notification commit at a time, so within the others, each would wait for the disk alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import sqlalchemy as sa
from psycopg import sql
from sqlalchemy.orm import Session

from specimap_infra.errors import DatabaseUnavailableError
from specimap_infra.logs import logger

if TYPE_CHECKING:
    from specimap_infra.database import Database

QUEUED = "specimap_queued"
"""There is work in the queue that the payload names."""
JOB_EVENTS = "specimap_job_events"
"""The job that the payload names has more events."""
DELIVERIES = "specimap_deliveries"
"""There is a webhook to deliver."""
RETRY_SECONDS = 1.0
"""Pause between two tries to listen again."""
STOP_SECONDS = 0.5
"""How often a listener looks whether it is to stop; that asks the server nothing."""
_PENDING = "notifications"
_SEND = sa.text(
    "SELECT set_config('synchronous_commit', 'off', true), pg_notify(channel, payload) "
    "FROM unnest(CAST(:channels AS text[]), CAST(:payloads AS text[])) AS told (channel, payload)"
)


def tell(session: Session, channel: str, payload: str = "") -> None:
    """Notify listeners once the transaction has been committed; on SQLite there are none."""
    session.info.setdefault(_PENDING, {})[channel, payload] = None


def send(session: Session) -> None:
    """Send what the committed transaction had to tell. Never raises for a server that does not answer."""
    pending = list(session.info.pop(_PENDING, ()))
    if not pending or session.get_bind().dialect.name == "sqlite":
        return
    channels, payloads = zip(*pending, strict=True)
    try:
        session.execute(_SEND, {"channels": list(channels), "payloads": list(payloads)})
        session.commit()
    except sa.exc.SQLAlchemyError as error:
        # What was to be told of is committed; the next look finds it.
        session.rollback()
        logger().debug("a notification was not sent", error=type(error).__name__)


class Listener:
    """A thread with a connection of its own that hears notifications.

    ``told`` gets channel and payload in that thread. It gets every channel with an empty payload whenever the listener
    begins to listen, also after an outage: what was told before was not heard.
    """

    def __init__(self, database: Database, channels: Sequence[str], told: Callable[[str, str], None]) -> None:
        self._database = database
        self._channels = tuple(channels)
        self._told = told
        self._stop = threading.Event()
        self._listening = threading.Event()
        self._thread = threading.Thread(target=self._run, name="listener", daemon=True)

    @property
    def listening(self) -> bool:
        """Whether notifications arrive; never on SQLite."""
        return self._listening.is_set()

    def start(self) -> None:
        """Begin, where the database sends notifications."""
        if self._database.engine.dialect.name != "sqlite":
            self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout=10)

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                self._listen()
            except DatabaseUnavailableError:
                pass  # the log tells once that it is away
            except Exception:
                # Without this thread everything would be found by polls alone, seconds late.
                logger().exception("listening for notifications failed")
            finally:
                self._listening.clear()
            self._stop.wait(RETRY_SECONDS)

    def _listen(self) -> None:
        with self._database.apart() as driver:
            for channel in self._channels:
                driver.execute(sql.SQL("LISTEN {}").format(sql.Identifier(channel)))
            self._listening.set()
            for channel in self._channels:
                self._told(channel, "")
            while not self._stop.is_set():
                for notification in driver.notifies(timeout=STOP_SECONDS):
                    self._told(notification.channel, notification.payload)
