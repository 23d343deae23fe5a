"""The tables of the full queue: the worst run counts, and limits follow from what was measured."""

from __future__ import annotations

import pytest
import sqlalchemy as sa

from bench.service.claimers import claim
from bench.service.full_queue import SMALL, fill
from bench.service.scale import NAMES
from bench.service.scale_sheets import sheet_scale
from specimap_infra.database import Database
from specimap_infra.job_schemas import queue_positions
from specimap_infra.queue import JOBS, queue_client
from specimap_infra.tables import Job


def figures(p99: float, idle: int) -> dict[str, object]:
    wait = {"p50_ms": 1.0, "p99_ms": 2.0}
    crowd = {"claimers": 100, "claims_per_second": 10.0, "claim": wait, "event": None, "list": wait, "submit": wait}
    return {
        "jobs": 10_000,
        "acquisitions": 1_000,
        "postgres_version": "15",
        "max_connections": 300,
        "runs": {"postgresql": {name: [wait, {"p50_ms": 3.0, "p99_ms": p99}] for name in NAMES}, "sqlite": {}},
        "crowds": {"storm 100": crowd | {"errors": {"A": 1, "B": 2}}},
        "api_connections": 31,
        "idle": {"connections": idle, "polls_per_second": 0.3, "transactions_per_second": 3.0},
    }


@pytest.mark.parametrize(("p99", "met"), [(99.0, "yes"), (101.0, "NO")])
def test_the_worst_run_counts(p99: float, met: str) -> None:
    waits, crowds, _ = sheet_scale(figures(p99, 5))
    for row in waits.rows:
        assert tuple(row[1:]) == ("3.0", f"{p99:.1f}", "<= 100", met, "-", "-", "-")
    assert crowds.rows[0][-1] == "3"


def test_workers_until_the_connections_are_used_up() -> None:
    *_, limits = sheet_scale(figures(1.0, 6))
    found = {row[0]: row[1] for row in limits.rows}
    # 100 less 3 for the administrator and 31 of the API.
    assert found["idle workers beside one API until `max_connections = 100` is used up"] == "11"
    assert found["connections of 100 idle workers"] == "600"


def test_without_postgresql_the_table_says_so() -> None:
    given = figures(1.0, 5)
    del given["crowds"]
    (waits,) = sheet_scale(given)
    assert "No PostgreSQL server answers" in waits.notes[-1]


def test_a_full_queue_is_one_that_workers_claim_from(tables: Database) -> None:
    full = fill(tables, acquisitions=4, jobs=12)
    assert len(full.acquisitions) == 4 - SMALL
    assert len(full.jobs) == 12
    client = queue_client(tables.engine)
    queue = client._sys_db.get_queue(JOBS)
    with tables.session() as session:
        places = queue_positions(session, full.jobs)
        assert [queue_positions(session, [job])[job] for job in full.jobs] == [places[job] for job in full.jobs]
        assert session.scalars(sa.select(sa.func.count()).where(Job.project_id == "")).one() == 0
    claimed = [claim(tables, client, queue, "bench:0:one")[0] for _ in range(13)]
    assert claimed == [*full.jobs, None]
    with tables.session() as session:
        assert {job.state for job in session.scalars(sa.select(Job).where(Job.id.in_(full.jobs)))} == {"running"}
