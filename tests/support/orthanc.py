"""A real Orthanc with DICOMweb and DIMSE, in a network namespace of its own.

Orthanc listens on every address. Inside the namespace nobody reaches it; from this process it is reached through ports
of 127.0.0.1, and it reaches ports of this process that it is told of.
"""

from __future__ import annotations

import json
import secrets
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.namespace_program import forward
from tests.support.places import SUPPORT

PLUGINS = Path("/usr/share/orthanc/plugins")
USER = "specimap"
AET = "ORTHANC"
_HTTP, _DICOM, _FIRST_PEER = 8042, 4242, 11200
_START_SECONDS = 20.0
_STOP_SECONDS = 10.0


@dataclass(frozen=True)
class RunningOrthanc:
    """``url``: its own REST; ``dicomweb_url``: DICOMweb's root; both take ``user`` and ``password`` (Basic).

    ``dicom_port`` of 127.0.0.1 speaks DIMSE to ``aet``; it knows and takes objects from any AE title. ``log``: what it
    wrote.
    """

    url: str
    dicom_port: int
    password: str
    log: Path
    aet: str = AET
    user: str = USER

    @property
    def dicomweb_url(self) -> str:
        """Root of DICOMweb: QIDO-RS, WADO-RS, STOW-RS."""
        return f"{self.url}/dicom-web"

    @property
    def auth(self) -> tuple[str, str]:
        """For httpx and requests."""
        return self.user, self.password

    def get(self, path: str) -> Any:
        """JSON of its own REST."""
        answer = httpx.get(f"{self.url}{path}", auth=self.auth, timeout=30, trust_env=False)
        answer.raise_for_status()
        return answer.json()

    def instances(self) -> set[str]:
        """SOP instance UIDs of all that it holds."""
        found: list[dict[str, Any]] = self.get("/instances?expand") or []
        return {instance["MainDicomTags"]["SOPInstanceUID"] for instance in found}


@cache
def _unshare() -> tuple[str, ...]:
    """The command that makes a namespace: as root, or in a user namespace too."""
    for command in (("unshare", "-n"), ("unshare", "-rn")):
        if (
            shutil.which("unshare")
            and subprocess.run([*command, "true"], capture_output=True, timeout=10).returncode == 0
        ):
            return command
    pytest.skip("this machine makes no network namespaces (unshare -n, unshare -rn): Orthanc would listen everywhere")


@contextmanager
def orthanc(
    folder: Path, *, peers: Mapping[str, int] | None = None, options: Mapping[str, Any] | None = None
) -> Iterator[RunningOrthanc]:
    """Run an Orthanc with its storage in ``folder`` until the block ends.

    ``peers``: AE titles that it may connect to itself (storage commitment, C-MOVE), each with a port of 127.0.0.1 here.
    ``options``: more of its configuration, such as ``{"Worklists": {"Enable": True, "Database": ...}}``.
    """
    program = shutil.which("Orthanc")
    if program is None or not PLUGINS.is_dir():
        pytest.skip("there is no Orthanc: apt-get install orthanc orthanc-dicomweb")
    folder.mkdir(parents=True, exist_ok=True)
    peers = dict(peers or {})
    password = secrets.token_hex(12)
    inner = {aet: _FIRST_PEER + k for k, aet in enumerate(peers)}
    config = {
        "Name": "specimap-tests",
        "StorageDirectory": str(folder / "storage"),
        "IndexDirectory": str(folder / "storage"),
        "Plugins": [str(PLUGINS)],
        "HttpPort": _HTTP,
        "DicomPort": _DICOM,
        "DicomAet": AET,
        "DicomCheckCalledAet": True,
        "RemoteAccessAllowed": True,
        "AuthenticationEnabled": True,
        "RegisteredUsers": {USER: password},
        "DicomAlwaysAllowEcho": True,
        "DicomAlwaysAllowStore": True,
        "DicomAlwaysAllowFind": True,
        "DicomAlwaysAllowFindWorklist": True,
        "DicomModalities": {aet: [aet, "127.0.0.1", port] for aet, port in inner.items()},
        "OverwriteInstances": True,
        "ConcurrentJobs": 2,
        "DicomWeb": {"Enable": True, "Root": "/dicom-web/"},
        **(options or {}),
    }
    path = folder / "orthanc.json"
    path.write_text(json.dumps(config), encoding="utf-8")
    with ExitStack() as stack:
        web = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        dicom = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        ours, theirs = socket.socketpair()
        stack.enter_context(ours)
        plan = {
            "command": [program, str(path)],
            "inward": [[web.fileno(), _HTTP], [dicom.fileno(), _DICOM]],
            "outward": list(inner.values()),
            "control": theirs.fileno(),
        }
        log = stack.enter_context(open(folder / "orthanc.log", "wb"))
        process = subprocess.Popen(
            [*_unshare(), sys.executable, str(SUPPORT / "namespace_program.py"), json.dumps(plan)],
            pass_fds=(web.fileno(), dicom.fileno(), theirs.fileno()),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        stack.callback(_stop, process)
        theirs.close()
        ours.settimeout(_START_SECONDS)
        for port in peers.values():
            _, descriptors, _, _ = socket.recv_fds(ours, 1, 1)
            way_back = stack.enter_context(socket.socket(fileno=descriptors[0]))
            threading.Thread(target=forward, args=(way_back, port), daemon=True).start()
        running = RunningOrthanc(
            f"http://127.0.0.1:{web.getsockname()[1]}", dicom.getsockname()[1], password, folder / "orthanc.log"
        )
        _wait_until_ready(running, process)
        yield running


def _wait_until_ready(running: RunningOrthanc, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + _START_SECONDS
    while time.monotonic() < deadline and process.poll() is None:
        try:
            running.get("/system")
        except httpx.HTTPError:
            time.sleep(0.1)
        else:
            return
    pytest.fail(f"Orthanc did not start:\n{running.log.read_text(errors='replace')[-2000:]}")


def _stop(process: subprocess.Popen[bytes]) -> None:
    # Orthanc goes with it; left to itself it takes two seconds to end.
    process.kill()
    process.wait(_STOP_SECONDS)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningOrthanc]:
    """An empty Orthanc for the tests of a module."""
    with orthanc(tmp_path_factory.mktemp("orthanc")) as running:
        yield running
