"""The API and the workers, killed again and again while 80 jobs come in over HTTP."""

from __future__ import annotations

import os
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from specimap_client import Client, Retries
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_service.auth.keys import new_key
from tests.support.scenes import Finished, OnDisk
from tests.support.worker_scene import QUICK, Shop, assert_all_succeed, shop, until

pytestmark = [pytest.mark.slow, pytest.mark.waits]

JOBS = 80
KILLS = 6


@contextmanager
def api(yard: Shop, port: int) -> Iterator[Callable[[], None]]:
    """An API process on a port; gives what kills it and starts it again."""
    environment = {**os.environ, **yard.environment, "SPECIMAP_PORT": str(port)}
    command = [sys.executable, "-c", "from specimap_cli import main; main()", "serve", "--no-worker"]
    processes: list[subprocess.Popen[bytes]] = []

    def answers() -> bool:
        with suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=1):
            return True
        return False

    def start() -> None:
        if processes:
            # One that has not begun to serve yet has nothing to lose.
            until(answers, 120, "the API")
            processes[-1].kill()
            processes[-1].wait(10)
        processes.append(subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL))

    start()
    try:
        yield start
    finally:
        processes[-1].kill()
        processes[-1].wait(10)


def test_no_job_is_lost_when_api_and_workers_are_killed_at_random(
    tmp_path: Path, small: OnDisk, finished: Finished
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    row, key = new_key("test", ["upload", "read"], project_id=DEFAULT_PROJECT, rate_per_minute=1_000_000)
    options = {"RESULT_FOLDER": str(finished.out), "STAGE_SECONDS": "0.05"}
    with shop(tmp_path / "shop") as yard, api(yard, port) as restart:
        with yard.database.session() as session:
            session.add(row)
        acquisition = yard.acquisition(small.photos, small.header)
        workers = [yard.start(QUICK, **options) for _ in range(3)]
        ids: list[str] = []

        def submit() -> None:
            patient = Retries(attempts=200, first_s=0.1, cap_s=1.0)
            with Client(f"http://127.0.0.1:{port}", key, retries=patient) as client:
                for number in range(JOBS):
                    # The key makes it safe to ask again after an answer that was lost with the API.
                    job = client.jobs.submit(acquisition, idempotency_key=f"job-{number}")
                    ids.append(job.id)

        submitting = threading.Thread(target=submit)
        submitting.start()
        rng = random.Random(11)
        for number in range(KILLS):
            time.sleep(rng.uniform(0.5, 2.0))
            if number % 2 == 0:
                restart()
            victim = rng.randrange(len(workers))
            workers[victim].kill()
            workers[victim] = yard.start(QUICK, **options)
        submitting.join(120)
        assert len(set(ids)) == JOBS

        assert_all_succeed(yard, ids)
