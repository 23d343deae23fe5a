"""The process that makes an export: it goes with its worker, and holds nothing of it."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from specimap_workers.exports import run_export
from tests.support.export_scene import address, ended
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running


@pytest.fixture
def result(service: Running, tmp_path: Path) -> Result:
    return put_result(service, tmp_path / "result")


@pytest.fixture
def client(service: Running) -> httpx.Client:
    return service.client()


def test_the_process_ends_with_its_worker(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "mesh.ply")  # nobody writes to it: reading it waits
    program = (
        "import os, subprocess, sys, time\n"
        "command = [sys.executable, '-m', 'specimap_workers.export_main', sys.argv[1], 'mesh-stl', sys.argv[2]]\n"
        "print(subprocess.Popen([*command, str(os.getpid()), '0']).pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    command = [sys.executable, "-c", program, str(tmp_path), str(tmp_path / "m.stl")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as worker:
        assert worker.stdout is not None
        pid = int(worker.stdout.readline())
        deadline = time.monotonic() + 20
        # Opening the pipe without waiting succeeds only once the other side reads.
        while time.monotonic() < deadline:
            try:
                writing = os.open(tmp_path / "mesh.ply", os.O_WRONLY | os.O_NONBLOCK)
                break
            except OSError:
                time.sleep(0.02)
        worker.kill()
    assert ended(pid)
    os.close(writing)


def test_the_process_does_nothing_for_a_worker_that_has_gone(result: Result, tmp_path: Path) -> None:
    target = tmp_path / "c.ply"
    command = [sys.executable, "-m", "specimap_workers.export_main", str(result.local), "ply", str(target), "1", "0"]
    assert subprocess.run(command, timeout=60).returncode == 1
    assert not target.exists()


def test_the_process_holds_nothing_of_the_worker(
    service: Running, client: httpx.Client, result: Result, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Its log, above all: a file that the worker writes could be emptied, a terminal read."""
    identities = tmp_path / "identities"
    script = tmp_path / "taken.py"
    script.write_text(
        "import os, pathlib, sys\n"
        "files = [os.fstat(number) for number in range(3)]\n"
        f"pathlib.Path({str(identities)!r}).write_text(' '.join(f'{{f.st_dev}}:{{f.st_ino}}' for f in files))\n"
        "pathlib.Path(sys.argv[3]).write_bytes(b'file')\n"
        "print('x' * 10_000_000)\n"
        "print('y' * 10_000_000, file=sys.stderr)\n"
    )
    popen = subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        return popen([command[0], str(script), *command[3:]], **options)

    monkeypatch.setattr(subprocess, "Popen", start)
    service_settings = service.settings.model_copy(update={"sandbox": "off"})
    export_id = client.post(address(result, "ply")).json()["id"]
    run_export(export_id, service.database, service.storage, service_settings, "worker-1")
    assert client.get(address(result, "ply")).json()["state"] == "succeeded"
    own = {f"{stat.st_dev}:{stat.st_ino}" for stat in map(os.fstat, range(3))} - {_of(os.devnull)}
    given = identities.read_text().split()
    assert given[0] == _of(os.devnull)
    assert not own & set(given)


def _of(path: str) -> str:
    stat = os.stat(path)
    return f"{stat.st_dev}:{stat.st_ino}"
