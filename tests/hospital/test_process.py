"""The hospital's process: alone, and beside the service; nothing that is away ends it."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_infra.database import Database
from specimap_infra.tables import DicomInstance
from tests.support.databases import create_tables
from tests.support.hospital_scene import KEY, as_json
from tests.support.orthanc import RunningOrthanc
from tests.support.outbox_scene import add_cloud, with_settings
from tests.support.result_scene import put_result
from tests.support.serve_scene import running
from tests.support.service_scene import serving
from tests.support.worker_scene import until


def archive_settings(archive: RunningOrthanc) -> dict[str, str]:
    return {
        "SPECIMAP_PACS_URL": archive.dicomweb_url,
        "SPECIMAP_PACS_USER": archive.user,
        "SPECIMAP_PACS_PASSWORD": archive.password,
        "SPECIMAP_STUDY_KEYS": json.dumps([KEY]),
    }


def sent(folder: Path) -> int:
    database = Database.open(f"sqlite:///{folder / 'specimap.db'}")
    try:
        with database.session() as session:
            states = list(session.scalars(sa.select(DicomInstance.state)))
    finally:
        database.close()
    return len(states) if states and set(states) == {"sent"} else 0


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [("serve", "--no-worker"), ("hospital",)])
def test_results_are_sent_by_the_service_and_by_the_process_alone(
    archive: RunningOrthanc, tmp_path: Path, arguments: tuple[str, ...]
) -> None:
    with serving(tmp_path / "data", study_keys=[KEY]) as service:
        result = put_result(service, tmp_path / "result")
        study = f"/v1/acquisitions/{result.acquisition_id}/study"
        assert service.client().put(study, json=as_json()).status_code == 200
    with running(tmp_path / "data", *arguments, **archive_settings(archive)) as program:
        count = until(lambda: sent(tmp_path / "data"), 90, "the objects to be sent")
        assert program.process.poll() is None
    assert count >= 4
    assert not any("Quasimodo" in line for line in program.lines)


@pytest.mark.slow
def test_an_archive_that_is_away_does_not_end_it(tmp_path: Path) -> None:
    settings = with_settings(None, data_dir=tmp_path / "data", study_keys=[KEY])
    database = Database.open(settings.database)
    create_tables(database)
    add_cloud(database, settings)
    database.close()
    away = {"SPECIMAP_PACS_URL": "http://127.0.0.1:9/dicom-web", "SPECIMAP_STUDY_KEYS": json.dumps([KEY])}
    with running(tmp_path / "data", "hospital", **away) as program:
        until(lambda: any("not_reachable" in line for line in program.lines), 60, "a first attempt")
        assert program.process.poll() is None


def test_without_work_it_says_so_and_ends(tmp_path: Path) -> None:
    import os

    environment = {**os.environ, "SPECIMAP_DATA_DIR": str(tmp_path)}
    done = subprocess.run(
        [sys.executable, "-m", "specimap_hospital"], env=environment, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2
    assert "SPECIMAP_PACS_URL" in done.stderr


"""The process of the hospital's side as an operator runs it: its health check, and the audit trail that it forwards."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

from specimap_infra.migrate import migrate


def wait_for(met: Callable[[], bool], seconds: float = 60) -> None:
    end = time.monotonic() + seconds
    while not met():
        assert time.monotonic() < end
        time.sleep(0.2)


def environment(folder: Path, **given: str) -> dict[str, str]:
    settings = {"SPECIMAP_DATA_DIR": str(folder), "SPECIMAP_MIN_FREE_BYTES": "0", **given}
    return {**{k: v for k, v in os.environ.items() if not k.startswith("SPECIMAP_")}, **settings}


def health(env: dict[str, str]) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable, "-m", "specimap_cli", "hospital", "--health"], env=env, capture_output=True, text=True
    )
    return done.returncode, done.stdout + done.stderr


def test_the_process_forwards_the_audit_trail_and_its_health_is_told(tmp_path: Path) -> None:
    database = Database.open(f"sqlite:///{tmp_path / 'specimap.db'}")
    migrate(database)
    database.close()
    heard: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]

        def listen() -> None:
            while True:
                try:
                    peer, _ = listener.accept()
                except OSError:
                    return
                with peer:
                    while part := peer.recv(65536):
                        heard.append(part)

        threading.Thread(target=listen, daemon=True).start()
        env = environment(tmp_path, SPECIMAP_AUDIT_SYSLOG=f"tcp://127.0.0.1:{port}")
        assert health(env)[0] != 0
        made: Any = subprocess.run(
            [sys.executable, "-m", "specimap_cli", "keys", "create", "--name", "tablet", "--scope", "read"],
            env=env,
            capture_output=True,
            text=True,
        )
        assert made.returncode == 0, made.stderr
        process = subprocess.Popen([sys.executable, "-m", "specimap_cli", "hospital"], env=env, stderr=subprocess.PIPE)
        try:
            wait_for(lambda: any(b"key.create" in part or b"key_" in part for part in heard))
            wait_for(lambda: health(env)[0] == 0)
            assert "alive here: 1" in health(env)[1]
        finally:
            process.send_signal(signal.SIGTERM)
            _, said = process.communicate(timeout=60)
        assert process.returncode == 0, said
        assert health(env)[0] != 0
