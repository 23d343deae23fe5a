"""Jobs' rows: transitions, fences between workers, events without a gap; on each database."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError, TooFewPhotosError
from specimap_core.fiducials.detection import dictionary_named
from specimap_core.photos.reading import AcquisitionSettings
from specimap_core.pipeline.options import OPTIONS
from specimap_infra import jobs
from specimap_infra.completeness import LEAST_PHOTOS, missing
from specimap_infra.database import Database
from specimap_infra.errors import JobConflictError, LostLeaseError
from specimap_infra.tables import FINAL_STATES, JOB_STATES, Delivery, Job, StoredFile
from tests.support.job_scene import EXECUTOR, acquisition, events, queued_job, row

WEBHOOK = {"url": "http://127.0.0.1:1/", "secret": "0123456789abcdef"}
FINALS: tuple[jobs.FinalState, ...] = ("succeeded", "failed", "cancelled")


def started(database: Database, **options: object) -> str:
    job_id = queued_job(database, **options)  # type: ignore[arg-type]
    with database.session() as session:
        assert jobs.claim(session, job_id, EXECUTOR) is not None
    return job_id


def test_life_of_a_job_is_told_in_events(tables: Database) -> None:
    job_id = started(tables, webhook=WEBHOOK)
    with tables.session() as session:
        jobs.report_progress(session, job_id, EXECUTOR, "render", 0.25)
        jobs.log(session, job_id, EXECUTOR, "warning", "Slow.", seconds=math.nan, path=LEAST_PHOTOS)
        assert (row_in(session, job_id).stage, row_in(session, job_id).progress) == ("render", 0.25)
        error = TooFewPhotosError("Two photos.", advice="Take more.", found=2)
        jobs.finish(session, job_id, EXECUTOR, "failed", error, {"reconstruct": 1.23456})
    job = row(tables, job_id)
    assert (job.state, job.starts, job.executor, job.seconds) == ("failed", 1, EXECUTOR, {"reconstruct": 1.235})
    assert job.error == {
        "code": "too_few_photos",
        "message": "Two photos.",
        "advice": "Take more.",
        "details": {"found": 2},
    }
    assert job.started_at is not None
    assert job.finished_at is not None
    assert job.created_at <= job.started_at <= job.finished_at
    described = [(e.seq, e.type, e.data) for e in events(tables, job_id)]
    assert described == [
        (1, "state", {"state": "queued", "starts": 0}),
        (2, "state", {"state": "running", "starts": 1}),
        (3, "progress", {"stage": "render", "progress": 0.25}),
        (4, "log", {"level": "warning", "message": "Slow.", "data": {"seconds": None, "path": 6}}),
        (5, "state", {"state": "failed", "error": job.error, "cloud_id": None}),
    ]
    with tables.session() as session:
        (delivery,) = session.scalars(sa.select(Delivery).where(Delivery.job_id == job_id))
        assert (delivery.state, delivery.attempts) == ("pending", 0)


def row_in(session: Session, job_id: str) -> Job:
    return session.get_one(Job, job_id)


@pytest.mark.parametrize("final", FINALS)
def test_final_states_never_change(tables: Database, final: jobs.FinalState) -> None:
    job_id = started(tables)
    with tables.session() as session:
        jobs.finish(session, job_id, EXECUTOR, final)
    before = [e.seq for e in events(tables, job_id)]
    for state in JOB_STATES:
        with pytest.raises(JobConflictError) as caught, tables.session() as session:
            jobs.set_state(session, job_id, state)  # type: ignore[arg-type]
        assert caught.value.details == {"state": final, "wanted": state}
    with tables.session() as session:
        assert jobs.claim(session, job_id, "host:0:two") is None
        assert jobs.release(session, job_id, EXECUTOR, died=True) is None
        assert jobs.fail_orphan(session, job_id, {"code": "x"}) is None
    assert row(tables, job_id).state == final
    assert [e.seq for e in events(tables, job_id)] == before


def test_queued_job_cannot_succeed_and_final_states_are_those_nothing_follows(tables: Database) -> None:
    job_id = queued_job(tables)
    with pytest.raises(JobConflictError), tables.session() as session:
        jobs.set_state(session, job_id, "succeeded")
    assert row(tables, job_id).state == "queued"
    assert {state for state, following in jobs.FOLLOWING.items() if not following} == set(FINAL_STATES)
    assert set(jobs.FOLLOWING) == set(JOB_STATES)


WRITES: dict[str, Callable[[Session, str], object]] = {
    "progress": lambda s, j: jobs.report_progress(s, j, EXECUTOR, "adjust", 0.5),
    "log": lambda s, j: jobs.log(s, j, EXECUTOR, "info", "Still here."),
    "finish": lambda s, j: jobs.finish(s, j, EXECUTOR, "succeeded"),
    "set_state": lambda s, j: jobs.set_state(s, j, "failed", executor=EXECUTOR),
}


@pytest.mark.slow
@pytest.mark.parametrize("write", WRITES.values(), ids=WRITES)
@pytest.mark.parametrize("how", ["taken over", "released", "cancelled"])
def test_worker_that_lost_the_job_changes_nothing(
    tables: Database, how: str, write: Callable[[Session, str], object]
) -> None:
    job_id = started(tables, webhook=WEBHOOK)
    with tables.session() as session:
        if how == "cancelled":
            jobs.request_cancel(session, job_id)
        else:
            jobs.release(session, job_id, EXECUTOR, died=True)
        if how == "taken over":
            jobs.claim(session, job_id, "host:1:two")
    before, described = row(tables, job_id), [e.seq for e in events(tables, job_id)]
    with pytest.raises((LostLeaseError, JobConflictError)), tables.session() as session:
        write(session, job_id)
    after = row(tables, job_id)
    assert [e.seq for e in events(tables, job_id)] == described
    for column in Job.__table__.columns:
        assert getattr(after, column.name) == getattr(before, column.name)
    with tables.session() as session:
        deliveries = session.scalar(sa.select(sa.func.count()).select_from(Delivery).where(Delivery.job_id == job_id))
    assert deliveries == (1 if how == "cancelled" else 0)


def test_released_job_is_claimed_again_and_keeps_its_start(tables: Database) -> None:
    job_id = started(tables)
    first = row(tables, job_id).started_at
    with tables.session() as session:
        jobs.report_progress(session, job_id, EXECUTOR, "register", 0.9)
        jobs.release(session, job_id, EXECUTOR, died=True)
    waiting = row(tables, job_id)
    assert (waiting.state, waiting.executor, waiting.stage, waiting.progress) == ("queued", None, "register", 0.0)
    with tables.session() as session:
        assert jobs.claim(session, job_id, "host:1:two") is not None
    job = row(tables, job_id)
    assert (job.state, job.executor, job.starts, job.started_at) == ("running", "host:1:two", 2, first)


def test_orphan_fails_without_a_fence(tables: Database) -> None:
    job_id = started(tables)
    with tables.session() as session:
        job = jobs.fail_orphan(session, job_id, {"code": "worker_crashed", "message": "", "advice": "", "details": {}})
    assert job is not None
    assert row(tables, job_id).state == "failed"
    assert events(tables, job_id)[-1].data["error"]["code"] == "worker_crashed"


def test_jobs_that_are_gone(tables: Database) -> None:
    gone = "job_" + "0" * 26
    with tables.session() as session:
        assert jobs.claim(session, gone, EXECUTOR) is None
        assert jobs.release(session, gone, EXECUTOR, died=True) is None
        with pytest.raises(LostLeaseError):
            jobs.log(session, gone, EXECUTOR, "info", "Anyone?")
        for call in (jobs.request_cancel, lambda s, j: jobs.append_event(s, j, "log", {})):
            with pytest.raises(NotFoundError):
                call(session, gone)


def test_writers_at_once_number_events_without_a_gap(tables: Database) -> None:
    job_id = started(tables)

    def write(writer: int) -> None:
        for n in range(10):
            with tables.session() as session:
                jobs.log(session, job_id, EXECUTOR, "info", "Line.", writer=writer, n=n)

    with ThreadPoolExecutor(6) as pool:
        list(pool.map(write, range(6)))
    described = events(tables, job_id)
    assert [e.seq for e in described] == list(range(1, 63))
    for writer in range(6):
        assert [e.data["data"]["n"] for e in described if e.data.get("data", {}).get("writer") == writer] == list(
            range(10)
        )


def test_one_of_many_ends_wins(tables: Database) -> None:
    job_id = started(tables, webhook=WEBHOOK)

    def end(n: int) -> bool:
        try:
            with tables.session() as session:
                if n % 2:
                    jobs.request_cancel(session, job_id)
                    return False
                jobs.finish(session, job_id, EXECUTOR, "succeeded")
                return True
        except (LostLeaseError, JobConflictError):
            return False

    with ThreadPoolExecutor(8) as pool:
        finished = list(pool.map(end, range(8)))
    assert sum(finished) == (1 if row(tables, job_id).state == "succeeded" else 0)
    assert [e.type for e in events(tables, job_id)] == ["state"] * 3
    with tables.session() as session:
        assert session.scalar(sa.select(sa.func.count()).select_from(Delivery)) == 1


# ---- readiness ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("photos", "others", "sentences"),
    [
        (6, ["cube.hdr", "cube.raw"], []),
        (6, ["cube.h5"], []),
        (6, ["cube.hdr", "cube.raw", "white.hdr", "white.raw", "dark.npy"], []),
        (5, ["cube.npy"], ["5 usable photos; at least 6 are needed."]),
        (6, [], ["There is no usable cube."]),
        (6, ["cube.hdr"], ["The cube's data file (cube.raw) has not arrived."]),
        (6, ["cube.raw"], ["The cube's header (cube.hdr) has not arrived."]),
        (6, ["cube.tif", "white.hdr"], ["The white reference's data file (white.raw) has not arrived."]),
        (6, ["cube.mat", "dark.npy"], ["The dark reference has no white one beside it."]),
        (0, [], ["0 usable photos; at least 6 are needed.", "There is no usable cube."]),
    ],
)
def test_what_is_missing(sqlite_tables: Database, photos: int, others: list[str], sentences: list[str]) -> None:
    acquisition_id = acquisition(sqlite_tables, photos=photos, others=others)
    with sqlite_tables.session() as session:
        assert missing(session, acquisition_id) == sentences


def test_refused_files_do_not_count(sqlite_tables: Database) -> None:
    acquisition_id = acquisition(sqlite_tables)
    with sqlite_tables.session() as session:
        session.execute(sa.update(StoredFile).where(StoredFile.role == "photo").values(state="refused"))
        assert missing(session, acquisition_id) == ["0 usable photos; at least 6 are needed."]


def test_light_rules_are_the_pipelines() -> None:
    assert AcquisitionSettings().least_photos == LEAST_PHOTOS
    for name in OPTIONS["dictionary"].choices:
        dictionary_named(name)
