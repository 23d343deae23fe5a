"""The wait of a queue's thread: it ends for a notification, for the end of work, and for a poll."""

from __future__ import annotations

import inspect
import threading
import time
from collections.abc import Callable
from pathlib import Path

import dbos._dbos
import dbos._queue
import dbos._workflow_commands
import pytest
import sqlalchemy as sa

from specimap_infra.notifications import QUEUED, tell
from specimap_infra.queue import JOBS
from specimap_workers.queue_threads import Wakeable
from tests.support.databases import postgres_url
from tests.support.scenes import Finished, OnDisk
from tests.support.worker_scene import QUICK, shop

NEVER = 3600.0


def ended(wait: Callable[[], object]) -> bool:
    """Whether a wait ends by itself, in a thread of its own, as it does not do by its time."""
    thread = threading.Thread(target=wait, daemon=True)
    thread.start()
    thread.join(20)
    return not thread.is_alive()


def test_a_notification_ends_the_wait_also_one_from_before_it() -> None:
    wakeable = Wakeable(lambda: False, lambda: True)
    timer = threading.Timer(0.2, wakeable.wake)
    timer.start()
    assert ended(lambda: wakeable.wait(NEVER))
    wakeable.wake()
    assert ended(lambda: wakeable.wait(NEVER))
    # It is used up then.
    start = time.monotonic()
    assert wakeable.wait(0.3) is False
    assert time.monotonic() - start >= 0.3


def test_without_notifications_the_wait_ends_soon() -> None:
    deaf = Wakeable(lambda: False, lambda: False)
    assert ended(lambda: deaf.wait(NEVER))


def test_stopping_ends_the_wait_whether_there_is_work_or_not() -> None:
    for busy in (True, False):
        wakeable = Wakeable(lambda busy=busy: busy, lambda: True)  # type: ignore[misc]
        threading.Timer(0.2, wakeable.set).start()
        assert ended(lambda wakeable=wakeable: wakeable.wait(NEVER))  # type: ignore[misc]
        assert wakeable.wait(NEVER) is True


def test_a_queue_that_holds_work_waits_for_its_end_and_not_for_the_poll() -> None:
    working = threading.Event()
    working.set()
    wakeable = Wakeable(working.is_set, lambda: True)
    waiting = threading.Thread(target=wakeable.wait, args=(0.01,), daemon=True)
    waiting.start()
    wakeable.wake()
    waiting.join(0.5)
    assert waiting.is_alive()
    working.clear()
    waiting.join(20)
    assert not waiting.is_alive()


def test_work_that_ends_between_two_waits_is_not_overlooked() -> None:
    busy = iter([False, True])  # within the wait, and as it ends
    wakeable = Wakeable(lambda: next(busy, False), lambda: True)
    wakeable.wake()
    wakeable.wait(NEVER)
    assert ended(lambda: wakeable.wait(NEVER))


def test_the_engine_has_what_is_changed_in_it() -> None:
    """Its version is pinned; another one may look elsewhere."""
    assert list(inspect.signature(dbos._queue.queue_worker_thread).parameters) == ["stop_event", "dbos", "queue"]
    launch = inspect.getsource(dbos._dbos.DBOS._launch)
    assert "target=queue_thread, args=(evt, self)" in launch
    assert "background_thread_stop_events.append(evt)" in launch
    assert "_BACKGROUND_JOBS_INTERVAL_SEC" in inspect.getsource(dbos._workflow_commands.background_jobs_thread)


@pytest.mark.slow
def test_jobs_run_one_after_the_other_without_any_poll(tmp_path: Path, small: OnDisk, finished: Finished) -> None:
    """The queue's poll is put off for an hour; the jobs come in by notifications, and follow by their ends."""
    with postgres_url() as url, shop(tmp_path, database_url=url) as yard:
        acquisition = yard.acquisition(small.photos, small.header)
        yard.start(QUICK, RESULT_FOLDER=str(finished.out))
        with yard.database.session() as session:
            session.execute(sa.text("UPDATE dbos.queues SET polling_interval_sec = 3600"))
            tell(session, QUEUED, JOBS)
        first = yard.submit(acquisition)
        assert yard.ended(first).state == "succeeded"
        rest = [yard.submit(acquisition) for _ in range(3)]
        assert [yard.ended(job).state for job in rest] == ["succeeded"] * 3
