"""The rule that tells a job that kills its process from one whose process is killed."""

from __future__ import annotations

import signal

import pytest
import sqlalchemy as sa

from specimap_infra import jobs
from specimap_infra.database import Database
from specimap_infra.setbacks import LONGEST_PAUSE_SECONDS, MOST_ATTEMPTS, Setbacks, ended_from_outside, pause_seconds
from specimap_infra.tables import Job
from tests.support.job_scene import EXECUTOR, queued_job, row

LIMITS = {"crashes": 3, "interruptions": 5}


def test_what_is_stored_is_read_again() -> None:
    setbacks = Setbacks().attempted().crashed("a").interrupted("b", 100.0).interrupted("c", 200.0)
    assert Setbacks.of(setbacks.stored()) == setbacks
    assert Setbacks.of({}) == Setbacks()
    assert setbacks.retry_at == 201.0


def test_each_end_counts_once_and_has_its_own_limit() -> None:
    setbacks = Setbacks()
    for name in ("a", "a", "b"):
        setbacks = setbacks.crashed(name)
    for name in ("a", "b", "c", "d", "d"):
        setbacks = setbacks.interrupted(name, 0.0)
    assert setbacks.cause(**LIMITS) is None
    assert setbacks.crashed("c").cause(**LIMITS) == "crashes"
    assert setbacks.interrupted("e", 0.0).cause(**LIMITS) == "interruptions"
    assert setbacks.interrupted("e", 0.0).without("b").cause(**LIMITS) is None


def test_no_stage_is_taken_up_for_ever() -> None:
    setbacks = Setbacks(attempts=MOST_ATTEMPTS)
    assert setbacks.cause(**LIMITS) is None
    assert setbacks.attempted().cause(**LIMITS) == "attempts"


def test_pauses_grow_to_a_limit() -> None:
    pauses = [pause_seconds(count) for count in range(1, 16)]
    assert pauses[:5] == [0.0, 1.0, 2.0, 4.0, 8.0]
    assert pauses == sorted(pauses)
    assert pauses[-1] == LONGEST_PAUSE_SECONDS
    # So a job that takes every worker along has failed after some minutes.
    assert sum(pauses) < 360


@pytest.mark.parametrize(
    ("status", "memory_ran_out", "outside"),
    [
        (-signal.SIGKILL, False, True),
        (-signal.SIGKILL, True, False),
        (-signal.SIGTERM, True, True),
        (-signal.SIGSEGV, False, False),
        (-signal.SIGABRT, False, False),
        (-signal.SIGBUS, False, False),
        (0, False, False),
        (1, False, False),
        (9, False, False),
    ],
)
def test_signals_of_other_processes_are_told_from_a_programs_own(
    status: int, memory_ran_out: bool, outside: bool
) -> None:
    assert ended_from_outside(status, memory_ran_out=memory_ran_out) == outside


def setbacks_of(database: Database, job_id: str) -> Setbacks:
    return Setbacks.of(row(database, job_id).setbacks)


def test_a_worker_that_stops_or_loses_its_lease_is_no_setback(tables: Database) -> None:
    job_id = queued_job(tables)
    with tables.session() as session:
        jobs.claim(session, job_id, EXECUTOR)
        jobs.release(session, job_id, EXECUTOR, died=False)
        jobs.claim(session, job_id, "host:1:two")
        jobs.release(session, job_id, EXECUTOR, died=True)  # late: it is another's now
    assert row(tables, job_id).state == "running"
    assert setbacks_of(tables, job_id).interruptions == ()
    with tables.session() as session:
        jobs.release(session, job_id, "host:1:two", died=True)
        jobs.release(session, job_id, "host:1:two", died=True)
    assert row(tables, job_id).state == "queued"
    assert setbacks_of(tables, job_id).interruptions == ("host:1:two",)
    with tables.session() as session:
        jobs.take_back(session, "host:1:two")
    assert setbacks_of(tables, job_id).interruptions == ()
    assert row(tables, job_id).starts == 2


def test_a_job_waits_longer_after_each_interruption(tables: Database) -> None:
    job_id = queued_job(tables)
    for number, goes_on in enumerate((True, False)):
        with tables.session() as session:
            jobs.claim(session, job_id, f"host:0:{number}")
            jobs.release(session, job_id, f"host:0:{number}", died=True)
        with tables.session() as session:
            assert jobs.may_go_on(session, Setbacks.of(session.get_one(Job, job_id).setbacks)) == goes_on


def test_rows_of_the_version_before_have_no_setbacks(tables: Database) -> None:
    job_id = queued_job(tables)
    columns = [column.name for column in Job.__table__.columns if column.name != "setbacks"]
    names = ", ".join(f'"{name}"' for name in columns)
    values = names.replace('"id"', "'job_before'")
    with tables.session() as session:
        session.execute(sa.text(f"INSERT INTO jobs ({names}) SELECT {values} FROM jobs"))
    assert setbacks_of(tables, "job_before") == Setbacks()
    with tables.session() as session:
        assert jobs.claim(session, "job_before", EXECUTOR) is not None
    assert setbacks_of(tables, "job_before").attempts == 1
    assert job_id
