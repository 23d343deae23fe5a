"""Events as they come: resumed, to many, through an outage, until the end."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa
from psycopg import sql

from specimap_infra import jobs
from specimap_infra.database import Database, utc_now
from specimap_infra.queue import POLL_SECONDS
from specimap_infra.tables import ApiKey, Job
from specimap_service.auth import keys
from specimap_service.jobs import events
from tests.support.databases import postgres_server, postgres_url
from tests.support.job_scene import EXECUTOR, acquisition, queued_job
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving

Told = tuple[int, str, dict[str, Any]]


@contextmanager
def following(client: httpx.Client, job_id: str, headers: dict[str, str] | None = None) -> Iterator[Iterator[Told]]:
    """The stream's events as (seq, type, data)."""
    with client.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers or {}) as answer:
        assert answer.status_code == 200, answer.read()
        assert answer.headers["content-type"].startswith("text/event-stream")
        yield parsed(answer.iter_lines())


def parsed(lines: Iterator[str]) -> Iterator[Told]:
    fields: dict[str, str] = {}
    for line in lines:
        name, _, value = line.partition(": ")
        if line:
            fields[name] = value
        elif "data" in fields:
            yield int(fields["id"]), fields["event"], json.loads(fields["data"])
            fields = {}


def work(database: Database, job_id: str, steps: int, pause: float = 0.0) -> None:
    """Run a job as a worker does, with a progress event a step."""
    with database.session() as session:
        jobs.claim(session, job_id, EXECUTOR)
    for n in range(1, steps + 1):
        with database.session() as session:
            jobs.report_progress(session, job_id, EXECUTOR, "adjust", n / steps)
        time.sleep(pause)
    with database.session() as session:
        jobs.finish(session, job_id, EXECUTOR, "succeeded")


def expected(steps: int) -> list[tuple[int, str]]:
    types = ["state", "state", *["progress"] * steps, "state"]
    return list(enumerate(types, 1))


def until(condition: Callable[[], bool], seconds: float = 15) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come about"
        time.sleep(0.02)


def test_stream_tells_all_from_the_start_and_ends(service: Running) -> None:
    job_id = queued_job(service.database)
    client = service.client(["read"])
    with following(client, job_id) as described:
        first = next(described)
        assert first == (1, "state", {"state": "queued", "starts": 0})
        worker = threading.Thread(target=work, args=(service.database, job_id, 10, 0.05))
        worker.start()
        seen = [first, *described]
        worker.join()
    assert [(seq, type) for seq, type, _ in seen] == expected(10)
    assert seen[-1][2] == {"state": "succeeded", "error": None, "cloud_id": None}
    with following(client, job_id) as described:
        assert list(described) == seen


def test_stream_is_resumed_after_the_last_event_seen(service: Running) -> None:
    job_id = queued_job(service.database)
    client = service.client(["read"])
    worker = threading.Thread(target=work, args=(service.database, job_id, 60, 0.01))
    worker.start()
    seen: list[Told] = []
    while not seen or seen[-1][1] != "state" or seen[-1][2]["state"] != "succeeded":
        headers = {"Last-Event-ID": str(seen[-1][0])} if seen else {}
        with following(client, job_id, headers) as described:
            # The connection breaks after some events.
            for _, event in zip(range(7), described, strict=False):
                seen.append(event)
    worker.join()
    assert [(seq, type) for seq, type, _ in seen] == expected(60)
    path = f"/v1/jobs/{job_id}/events"
    assert client.get(path, headers={"Last-Event-ID": "63"}).status_code == 204
    assert client.get(path, params={"after": 63}).status_code == 204
    assert len(list(parsed(iter(client.get(path, params={"after": 61}).text.splitlines())))) == 2
    assert client.get(path, headers={"Last-Event-ID": "x"}).status_code == 422
    assert client.get(f"/v1/jobs/job_{'0' * 26}/events").status_code == 404


def test_a_number_beyond_the_last_event_delays_nobody(service: Running) -> None:
    """Neither the listener that gives it, first of all, nor those that come after."""
    job_id = queued_job(service.database)
    client = service.client(["read"])
    with following(client, job_id, {"Last-Event-ID": "999999999"}) as beyond, following(client, job_id) as described:
        assert next(described)[0] == 1
        work(service.database, job_id, 3)
        assert [(seq, type) for seq, type, _ in described] == expected(3)[1:]
        assert [(seq, type) for seq, type, _ in beyond] == expected(3)[1:]
    again = client.get(f"/v1/jobs/{job_id}/events", headers={"Last-Event-ID": "999999999"})
    assert again.status_code == 204


def test_listener_after_the_end_is_told_so_whatever_it_has_seen(service: Running) -> None:
    """A job may end between the look at its events and the look at its state."""
    job_id = queued_job(service.database)
    work(service.database, job_id, 1)
    with service.database.session() as session:
        job = session.get_one(Job, job_id)
        assert events.position(session, job, 0) == 0
        assert events.position(session, job, 3) == 3
        assert events.position(session, job, 4) is None
        assert events.position(session, job, 10**9) is None


@pytest.mark.parametrize("how", ["revoked", "revoked elsewhere", "expired"])
def test_stream_ends_with_its_key(service: Running, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keys, "KEPT_SECONDS", 0.3)
    admin, client = service.client(), service.client(["read"])
    key_id = f"key_{client.headers['authorization'].split('_')[1]}"
    job_id = queued_job(service.database)
    with following(client, job_id) as described, following(admin, job_id) as other:
        assert next(described)[0] == next(other)[0] == 1
        if how == "revoked":
            assert admin.delete(f"/v1/keys/{key_id}").status_code == 204
        else:
            change = {"revoked_at": utc_now()} if how == "revoked elsewhere" else {"expires_at": utc_now()}
            with service.database.session() as session:
                session.execute(sa.update(ApiKey).where(ApiKey.id == key_id).values(**change))
        assert list(described) == []
        assert client.get(f"/v1/jobs/{job_id}/events").status_code == 401
        work(service.database, job_id, 2)
        assert [(seq, type) for seq, type, _ in other] == expected(2)[1:]


def test_a_key_follows_so_many_streams(tmp_path: Path) -> None:
    with serving(tmp_path, max_streams_per_key=2) as service:
        client, other = service.client(["read"]), service.client(["read"])
        job_id = queued_job(service.database)
        path = f"/v1/jobs/{job_id}/events"
        with following(client, job_id) as one, following(client, job_id) as two:
            assert next(one)[0] == next(two)[0] == 1
            refused = client.get(path)
            assert (refused.status_code, refused.json()["code"]) == (429, "rate_limited")
            assert int(refused.headers["retry-after"]) > 0
            with following(other, job_id) as third:
                assert next(third)[0] == 1
        # Closed streams, ended streams and refused requests give their places back.
        streams = service.app.state.streams
        until(lambda: not streams._counts)
        assert client.get(f"/v1/jobs/job_{'0' * 26}/events").status_code == 404
        work(service.database, job_id, 1)
        for _ in range(3):
            assert client.get(path).status_code == 200
            until(lambda: not streams._counts)


@pytest.mark.slow
def test_many_listeners_cost_one_look_into_the_database(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    looks: list[dict[str, int]] = []
    read = events.read_events

    def counted(database: Database, after: dict[str, int]) -> dict[str, list[events.Event]]:
        looks.append(after)
        return read(database, after)

    monkeypatch.setattr(events, "read_events", counted)
    owner = acquisition(service.database)
    ids = [queued_job(service.database, owner) for _ in range(3)]
    listeners = 45
    started = threading.Barrier(listeners + 1, timeout=30)
    client = service.client(["read"])

    def listen(n: int) -> list[Told]:
        with following(client, ids[n % 3]) as described:
            first = next(described)
            started.wait()
            return [first, *described]

    with ThreadPoolExecutor(listeners) as pool, httpx.Client(trust_env=False, verify=NO_TLS) as stranger:
        listening = [pool.submit(listen, n) for n in range(listeners)]
        started.wait()
        looks.clear()
        begun = time.monotonic()
        with ThreadPoolExecutor(3) as workers:
            for job_id in ids:
                workers.submit(work, service.database, job_id, 20, 0.05)
            assert stranger.get(f"{service.url}/healthz").status_code == 200
        described = [done.result(timeout=30) for done in listening]
        seconds = time.monotonic() - begun
    for seen in described:
        assert [(seq, type) for seq, type, _ in seen] == expected(20)
    assert len(looks) <= seconds / POLL_SECONDS + 4
    feed: events.JobEvents = service.app.state.job_events
    until(lambda: not feed._channels)
    until(lambda: feed._poller is not None and feed._poller.done())
    assert service.database.engine.pool.checkedout() == 0  # type: ignore[attr-defined]


def test_listener_far_behind_reads_what_is_not_kept(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "PAGE", 20)
    job_id = queued_job(service.database)
    client = service.client(["read"])
    with following(client, job_id, {"Last-Event-ID": "1"}) as ahead:
        worker = threading.Thread(target=work, args=(service.database, job_id, 100))
        worker.start()
        assert next(ahead)[0] == 2
        with following(client, job_id) as behind:
            assert [(seq, type) for seq, type, _ in behind] == expected(100)
        worker.join()
        assert [seq for seq, _, _ in ahead] == list(range(3, 104))


def test_stream_of_a_deleted_job_ends_and_an_idle_one_is_kept_alive(
    service: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(events, "KEEP_ALIVE_SECONDS", 0.2)
    job_id = queued_job(service.database)
    with service.client(["read"]).stream("GET", f"/v1/jobs/{job_id}/events") as answer:
        lines = answer.iter_lines()
        assert sum(1 for _, line in zip(range(12), lines, strict=False) if line.startswith(":")) >= 3
        with service.database.session() as session:
            session.execute(sa.text("DELETE FROM acquisitions"))
        assert all(not line or line.startswith(":") for line in lines)


@pytest.mark.slow
def test_stream_lives_through_an_outage_of_the_database(tmp_path: Path) -> None:
    """No connection to the database can be had for three seconds, and those that were there are cut."""
    with postgres_url() as url, serving(tmp_path, database_url=url) as service, postgres_server() as server:
        name = sql.Identifier(url.rsplit("/", 1)[1])
        job_id = queued_job(service.database)
        client = service.client(["read"])
        with following(client, job_id) as described:
            assert next(described)[0] == 1
            server.execute(sql.SQL("ALTER DATABASE {} ALLOW_CONNECTIONS false").format(name))
            server.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE datname = %s", [url.rsplit("/", 1)[1]]
            )
            away = client.get(f"/v1/jobs/{job_id}")
            assert (away.status_code, away.json()["code"]) == (503, "database_unavailable")
            over = time.monotonic() + 3
            until(lambda: time.monotonic() > over)
            server.execute(sql.SQL("ALTER DATABASE {} ALLOW_CONNECTIONS true").format(name))
            work(service.database, job_id, 3)
            assert [(seq, type) for seq, type, _ in described] == expected(3)[1:]


@pytest.mark.slow
def test_events_come_by_notifications_without_any_poll(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(events, "QUIET_SECONDS", 3600.0)
    with postgres_url() as url, serving(tmp_path, database_url=url) as service:
        job_id = queued_job(service.database)
        until(lambda: service.app.state.job_events._listener.listening)
        with following(service.client(["read"]), job_id) as described:
            assert next(described)[0] == 1
            work(service.database, job_id, 20, 0.02)
            assert [(seq, type) for seq, type, _ in described] == expected(20)[1:]
