"""The archive that other tests use: reached from here alone, and by those that may."""

from __future__ import annotations

import socket
import subprocess
import threading
from pathlib import Path

import httpx
from pynetdicom import AE, evt
from pynetdicom.sop_class import Verification  # type: ignore[attr-defined]

from tests.support.orthanc import RunningOrthanc, orthanc


def test_it_answers_with_the_password_and_not_without(archive: RunningOrthanc) -> None:
    assert archive.get("/system")["DicomAet"] == archive.aet
    assert httpx.get(f"{archive.dicomweb_url}/studies", trust_env=False).status_code == 401
    found = httpx.get(f"{archive.dicomweb_url}/studies", auth=archive.auth, trust_env=False)
    assert found.status_code in (200, 204)


def test_it_speaks_dimse(archive: RunningOrthanc) -> None:
    done = subprocess.run(
        ["echoscu", "-aec", archive.aet, "127.0.0.1", str(archive.dicom_port)], capture_output=True, timeout=30
    )
    assert done.returncode == 0, done.stderr


def test_nothing_of_it_listens_outside(archive: RunningOrthanc) -> None:
    with socket.socket() as other:
        assert other.connect_ex(("127.0.0.1", 4242)) != 0 or archive.dicom_port == 4242


def test_it_reaches_a_peer_here(tmp_path: Path) -> None:
    asked = threading.Event()

    def on_echo(_: evt.Event) -> int:
        asked.set()
        return 0

    ae = AE("PEER")
    ae.add_supported_context(Verification)
    server = ae.start_server(("127.0.0.1", 0), block=False, evt_handlers=[(evt.EVT_C_ECHO, on_echo)])
    assert server is not None
    try:
        with orthanc(tmp_path / "orthanc", peers={"PEER": server.server_address[1]}) as running:
            answer = httpx.post(
                f"{running.url}/modalities/PEER/echo", json={}, auth=running.auth, timeout=30, trust_env=False
            )
            assert answer.status_code == 200
            assert asked.wait(10)
    finally:
        server.shutdown()
