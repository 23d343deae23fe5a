"""Databases and stores that are away, refusing or hanging: jobs go on, the API answers, workers come back."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import pytest
import sqlalchemy as sa

from specimap_core.pipeline.clock import STAGES
from tests.support.databases import postgres_url
from tests.support.gate import Gate
from tests.support.object_store import object_store
from tests.support.plain_http import NO_TLS
from tests.support.scenes import Finished, OnDisk
from tests.support.serve_scene import running
from tests.support.service_scene import serving
from tests.support.worker_scene import QUICK, Shop, processes_of, shop, until

pytestmark = [pytest.mark.slow, pytest.mark.waits]

LONG = os.environ.get("SPECIMAP_TEST_OUTAGE_SECONDS")
SECONDS = dict.fromkeys(("shut", "hang"), float(LONG)) if LONG else {"shut": 4.0, "hang": 14.0}
"""Length of an outage: a hanging server is given up after twelve. The variable sets another one."""


@dataclass(frozen=True)
class Behind:
    """A server behind a gate: the settings of who reaches it past the gate, and through it."""

    gate: Gate
    past: dict[str, Any]
    through: dict[str, Any]

    @contextmanager
    def away(self, how: str) -> Iterator[None]:
        """An outage for the time of the block."""
        (self.gate.shut if how == "shut" else self.gate.hang)()
        try:
            yield
        finally:
            self.gate.open()


@pytest.fixture(params=["database", "storage"])
def behind(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Behind]:
    """Each kind of server."""
    if request.param == "database":
        with postgres_url() as url:
            parsed = sa.make_url(url)
            assert parsed.host is not None
            with Gate((parsed.host, parsed.port or 5432)) as gate:
                through = parsed.set(host="127.0.0.1", port=gate.port).render_as_string(hide_password=False)
                yield Behind(gate, {"database_url": url}, {"database_url": through})
        return
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
    with object_store("specimap") as endpoint:
        address = urlsplit(endpoint)
        assert address.hostname is not None
        assert address.port is not None
        with Gate((address.hostname, address.port)) as gate:
            past = {"storage": "s3://specimap/site", "s3_endpoint": endpoint}
            yield Behind(gate, past, {**past, "s3_endpoint": f"http://127.0.0.1:{gate.port}"})


def variables(settings: dict[str, Any]) -> dict[str, str]:
    return {f"SPECIMAP_{name.upper()}": value for name, value in settings.items()}


def in_stage(yard: Shop, job_id: str, stage: str) -> bool:
    return yard.job(job_id).stage == stage


@pytest.mark.parametrize("how", ["shut", "hang"])
def test_a_job_goes_on_after_an_outage_in_every_stage(
    tmp_path: Path, small: OnDisk, finished: Finished, behind: Behind, how: str
) -> None:
    with shop(tmp_path / "shop", **behind.past) as yard:
        options = {"RESULT_FOLDER": str(finished.out), "STAGE_SECONDS": "1.5"}
        yard.start(QUICK, **variables(behind.through), **options)
        job_id = yard.submit(yard.acquisition(small.photos, small.header))
        for stage in STAGES:
            until(partial(in_stage, yard, job_id, stage), 60, f"stage {stage}")
            with behind.away(how):
                # The stage ends meanwhile, so that what it left is stored, or published, in the outage.
                time.sleep(SECONDS[how])
        job = yard.ended(job_id, 120)
        assert (job.state, job.error) == ("succeeded", None)
        assert yard.storage.stat(f"{yard.cloud(job_id).prefix}/report.json").size > 1000


@pytest.mark.parametrize("how", ["shut", "hang"])
def test_the_api_answers_503_in_an_outage_and_is_ready_after_it(tmp_path: Path, behind: Behind, how: str) -> None:
    with serving(tmp_path / "service", own_judge=False, **behind.through) as service:
        client = service.client()

        def status(_: int = 0) -> tuple[int, str, str | None]:
            # It answers well before the client's own limit of a minute, however many ask.
            answer = client.get("/readyz")
            return answer.status_code, answer.json().get("code", ""), answer.headers.get("Retry-After")

        assert status() == (200, "", None)
        away = (503, "database_unavailable" if "database_url" in behind.past else "storage_unavailable", "5")
        with behind.away(how), ThreadPoolExecutor(60) as pool:
            assert set(pool.map(status, range(60))) == {away}
            assert client.get("/healthz").status_code == 200
        until(lambda: status()[0] == 200, 30, "readiness")


def test_a_worker_that_starts_in_an_outage_works_after_it(tmp_path: Path, behind: Behind) -> None:
    with running(tmp_path / "data", **variables(behind.through)) as served:
        url = served.printed("Specimap listens on ")

        def workers() -> int:
            answer = httpx.get(f"{url}/readyz", trust_env=False, verify=NO_TLS, timeout=60)
            return int(answer.json()["workers"]) if answer.status_code == 200 else -1

        def pids() -> list[int]:
            return processes_of(["specimap_workers", "--executor", str(served.process.pid)])

        until(lambda: workers() == 1, 40, "the worker")
        before = len(served.lines)
        (first,) = pids()
        with behind.away("shut"):
            os.kill(first, signal.SIGKILL)
            until(lambda: any("worker waits" in line for line in served.lines[before:]), 40, "the next worker")
            assert workers() == -1
            (second,) = pids()
        until(lambda: workers() == 1, 60, "the next worker's heartbeat")
        assert pids() == [second] != [first]
        told = "".join(served.lines[before:])
        assert "Traceback" not in told
        assert len(told) < 20_000
