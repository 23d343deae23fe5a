"""Exports whose process dies, hangs, is taken over or stopped: the row says so, and nothing half-written is served."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_core.errors import CancelledError
from specimap_infra.errors import StorageUnavailableError
from specimap_infra.storage import Storage
from specimap_infra.tables import CloudRow, Export
from specimap_workers import export_rows, exports
from specimap_workers.export_rows import claim, release_export
from specimap_workers.exports import run_export
from tests.support.export_scene import address, ended, make
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def client(service: Running) -> httpx.Client:
    return service.client()


@pytest.fixture
def slow(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[[], int]:
    """Processes that write half a file and then wait; gives the id of the one that runs, once it has."""
    script = tmp_path / "slow.py"
    script.write_text(
        "import os, pathlib, sys, time\n"
        "pathlib.Path(sys.argv[-3]).write_bytes(b'half')\n"
        f"pathlib.Path({str(tmp_path)!r}, 'pid-' + str(os.getpid())).touch()\n"
        "time.sleep(60)\n"
    )
    popen = subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        return popen([command[0], str(script), *command[3:]], **options)

    monkeypatch.setattr(subprocess, "Popen", start)
    seen: set[str] = set()

    def running() -> int:
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            new = {path.name for path in tmp_path.glob("pid-*")} - seen
            if new:
                seen.update(new)
                return int(new.pop()[4:])
            time.sleep(0.02)
        raise AssertionError("no process was started")

    return running


def nothing_left(service: Running) -> bool:
    stored = service.settings.data_dir / "storage" / "exports"
    return not list(service.settings.scratch.glob("exp_*")) and not list(stored.rglob("*"))


@pytest.mark.parametrize("by", [signal.SIGSEGV, signal.SIGKILL])
@pytest.mark.usefixtures("no_memory_kills")
def test_a_process_that_dies_is_started_again_and_then_failed(
    service: Running, client: httpx.Client, result: Result, slow: Callable[[], int], by: signal.Signals
) -> None:
    export_id = client.post(address(result, "ply")).json()["id"]
    # One more kill from outside than it may crash; each in its own right.
    limits = service.settings.model_copy(update={"starts": 2, "interruptions": 3})
    working = threading.Thread(
        target=run_export, args=(export_id, service.database, service.storage, limits, "worker-1")
    )
    working.start()
    for _ in range(limits.interruptions if by == signal.SIGKILL else limits.starts):
        pid = slow()
        assert client.get(address(result, "ply")).json()["state"] == "running"
        assert client.get(address(result, "ply") + "/content").status_code == 409
        os.kill(pid, by)
    working.join(20)
    export = client.get(address(result, "ply")).json()
    assert (export["state"], export["error"]["code"]) == ("failed", "worker_crashed")
    assert export["error"]["details"] == {"stage": "export", "status": -by}
    assert client.get(address(result, "ply") + "/content").status_code == 409
    assert nothing_left(service)


def test_an_export_that_takes_its_workers_along_is_failed(
    service: Running, client: httpx.Client, result: Result
) -> None:
    export_id = client.post(address(result, "ply")).json()["id"]
    limits = service.settings.model_copy(update={"interruptions": 2})
    for number in range(limits.interruptions):
        executor = f"worker-{number}"
        assert claim(service.database, export_id, executor) is not None
        for _ in range(2):  # told twice, it counts once
            with service.database.session() as session:
                release_export(session, export_id, executor, died=True)
    run_export(export_id, service.database, service.storage, limits, "worker-9")
    export = client.get(address(result, "ply")).json()
    assert (export["state"], export["error"]["code"]) == ("failed", "worker_crashed")


def test_an_export_waits_for_the_storage(
    service: Running, client: httpx.Client, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_id = client.post(address(result, "ply")).json()["id"]
    tries: list[int] = []
    fetch = Storage.fetch

    def fetching(storage: Storage, key: str, target: Path) -> None:
        tries.append(1)
        if len(tries) < 3:
            raise StorageUnavailableError("Away.", advice="Wait.")
        fetch(storage, key, target)

    monkeypatch.setattr(Storage, "fetch", fetching)
    make(service, export_id)
    assert len(tries) == 3
    assert client.get(address(result, "ply")).json()["state"] == "succeeded"


@pytest.mark.slow
def test_a_failed_one_is_tried_again_under_a_new_id(
    service: Running, client: httpx.Client, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = service.settings.data_dir / "storage" / result.prefix / "mesh.ply"
    whole = mesh.read_bytes()
    mesh.write_bytes(whole[:-100])
    first = client.post(address(result, "mesh-stl")).json()["id"]
    make(service, first)
    export = client.get(address(result, "mesh-stl")).json()
    assert (export["state"], export["error"]["code"]) == ("failed", "cloud_damaged")
    assert str(service.settings.data_dir) not in str(export)
    mesh.write_bytes(whole)
    second = client.post(address(result, "mesh-stl"))
    assert (second.status_code, second.json()["state"], second.json()["error"]) == (202, "queued", None)
    assert second.json()["id"] != first
    make(service, first)  # a late repetition of the first changes nothing
    assert client.get(address(result, "mesh-stl")).json() == second.json()
    make(service, second.json()["id"])
    assert client.get(address(result, "mesh-stl")).json()["state"] == "succeeded"


@pytest.mark.slow
def test_another_worker_takes_over_and_the_first_changes_nothing(
    service: Running, client: httpx.Client, result: Result, slow: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exports, "HELD_SECONDS", 0.1)
    export_id = client.post(address(result, "ply")).json()["id"]
    frozen = threading.Thread(target=make, args=(service, export_id, "worker-1"))
    frozen.start()
    pid = slow()
    monkeypatch.undo()
    make(service, export_id, "worker-2")
    frozen.join(20)
    assert not frozen.is_alive()
    assert ended(pid)
    assert client.get(address(result, "ply")).json()["state"] == "succeeded"
    assert client.get(address(result, "ply") + "/content").content.startswith(b"ply\n")
    with service.database.session() as session:
        row = session.get(Export, export_id)
        assert row is not None
        assert row.executor == "worker-2"


@pytest.mark.slow
def test_a_worker_that_comes_too_late_takes_its_file_back(
    service: Running, client: httpx.Client, result: Result, monkeypatch: pytest.MonkeyPatch
) -> None:
    export_id = client.post(address(result, "ply")).json()["id"]
    finish = export_rows.finish

    def late(*arguments: Any) -> bool:
        monkeypatch.undo()
        make(service, export_id, "worker-2")
        return finish(*arguments)

    monkeypatch.setattr(exports, "finish", late)
    make(service, export_id, "worker-1")
    stored = service.settings.data_dir / "storage" / "exports"
    (kept,) = (path for path in stored.rglob("*") if path.is_file())
    with service.database.session() as session:
        row = session.get(Export, export_id)
        assert row is not None
        assert (row.executor, row.state, row.size) == ("worker-2", "succeeded", kept.stat().st_size)
        assert row.storage_key is not None
        assert row.storage_key.endswith(f"/{kept.parent.name}/{kept.name}")


def test_stopping_the_worker_leaves_the_row_to_the_next(
    service: Running, client: httpx.Client, result: Result, slow: Callable[[], int]
) -> None:
    export_id = client.post(address(result, "ply")).json()["id"]
    stop = threading.Event()
    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(make, service, export_id, cancelled=stop.is_set)
        pid = slow()
        stop.set()
        with pytest.raises(CancelledError):
            working.result(timeout=20)
    assert ended(pid)
    assert nothing_left(service)
    assert client.get(address(result, "ply")).json()["state"] == "running"


def test_a_cloud_that_is_deleted_meanwhile(
    service: Running, client: httpx.Client, result: Result, slow: Callable[[], int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exports, "HELD_SECONDS", 0.1)
    export_id = client.post(address(result, "ply")).json()["id"]
    working = threading.Thread(target=make, args=(service, export_id))
    working.start()
    pid = slow()
    with service.database.session() as session:
        session.execute(sa.delete(CloudRow).where(CloudRow.id == result.cloud_id))
    working.join(20)
    assert not working.is_alive()
    assert ended(pid)
    assert nothing_left(service)


def test_a_stage_limit_holds_for_exports(
    service: Running, client: httpx.Client, result: Result, slow: Callable[[], int]
) -> None:
    export_id = client.post(address(result, "ply")).json()["id"]
    hasty = service.settings.model_copy(update={"stage_seconds": 0.5})
    run_export(export_id, service.database, service.storage, hasty, "worker-1")
    assert ended(slow())
    assert client.get(address(result, "ply")).json()["error"]["code"] == "stage_timeout"
