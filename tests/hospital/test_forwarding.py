"""The process of the hospital's side forwards the audit trail; its health check tells of it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from specimap_infra.database import Database
from tests.support.databases import create_tables
from tests.support.serve_scene import PROGRAM, running
from tests.support.worker_scene import until


@contextmanager
def listening() -> Iterator[tuple[int, list[bytes]]]:
    """A syslog server over TCP that keeps what it is sent; its port."""
    heard: list[bytes] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:

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
        yield listener.getsockname()[1], heard


def command(folder: Path, *arguments: str) -> tuple[int, str]:
    done = subprocess.run(
        [*PROGRAM, *arguments],
        env={**os.environ, "SPECIMAP_DATA_DIR": str(folder)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    return done.returncode, done.stdout + done.stderr


def test_the_trail_is_forwarded_and_the_health_of_the_process_is_told(tmp_path: Path) -> None:
    database = Database.open(f"sqlite:///{tmp_path / 'specimap.db'}")
    create_tables(database)
    database.close()
    status, said = command(tmp_path, "hospital", "--health")
    assert status != 0
    assert "No process of the hospital's side lives here." in said
    status, said = command(tmp_path, "keys", "create", "--name", "tablet", "--scope", "read")
    assert status == 0, said
    with (
        listening() as (port, heard),
        running(tmp_path, "hospital", SPECIMAP_AUDIT_SYSLOG=f"tcp://127.0.0.1:{port}") as program,
    ):
        until(lambda: any(b"key.create" in part or b"key_" in part for part in heard), 60, "a message")
        until(lambda: command(tmp_path, "hospital", "--health")[0] == 0, 60, "its health")
        program.process.send_signal(signal.SIGTERM)
        assert program.process.wait(60) == 0, program.lines
    assert command(tmp_path, "hospital", "--health")[0] != 0
