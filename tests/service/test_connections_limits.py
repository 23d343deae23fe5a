"""How many connections there may be, of one address and of all, and what happens at the limit of open files."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest

from tests.support.connection_scene import ASKED, connected, until
from tests.support.plain_http import NO_TLS
from tests.support.service_scene import Running, serving

# ---- how many ------------------------------------------------------------------------------------------


LONG = b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nAuthorization: %s\r\nContent-Length: 9\r\n\r\n"


def busy(service: Running, number: int) -> list[socket.socket]:
    """Connections with a request under way."""
    key = service.client().headers["Authorization"].encode()
    made = [connected(service) for _ in range(number)]
    for connection in made:
        connection.sendall(LONG % key)
    return made


def test_one_connection_too_many_is_told_so(tmp_path: Path) -> None:
    with serving(tmp_path, max_connections=20, max_connections_per_address=20) as service:
        held = busy(service, 20)
        until(lambda: len(service.server.server_state.tasks) == 20)
        # httpx has sent its request by the time that it reads the refusal.
        answer = httpx.get(f"{service.url}/healthz", trust_env=False, verify=NO_TLS)
        assert (answer.status_code, answer.json()["code"]) == (503, "too_many_connections")
        assert answer.headers["retry-after"] == "5"
        assert answer.headers["connection"] == "close"
        for connection in held:
            connection.close()
        until(lambda: not service.connections)
        assert httpx.get(f"{service.url}/healthz", trust_env=False, verify=NO_TLS).status_code == 200


def test_one_address_leaves_places_to_others(tmp_path: Path) -> None:
    with serving(tmp_path, max_connections=20, max_connections_per_address=10) as service:
        held = busy(service, 10)
        until(lambda: len(service.server.server_state.tasks) == 10)
        assert httpx.get(f"{service.url}/healthz", trust_env=False, verify=NO_TLS).status_code == 503
        other = httpx.HTTPTransport(local_address="127.0.0.2", verify=NO_TLS)
        with httpx.Client(transport=other) as client:
            assert client.get(f"{service.url}/healthz").status_code == 200
        for connection in held:
            connection.close()


HELD = {
    "nothing": b"",
    "half a head": b"GET /healthz HTTP/1.1\r\nX:",
    "an answer": ASKED,
    "half a body without a key": b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n1",
}


@pytest.mark.parametrize("what", HELD)
def test_who_asks_nothing_keeps_nobody_out(tmp_path: Path, what: str) -> None:
    with serving(tmp_path, max_connections=20, max_connections_per_address=20) as service:
        held = []
        for _ in range(30):
            held.append(connected(service))
            held[-1].sendall(HELD[what])
            if b"\r\n\r\n" in HELD[what]:
                assert held[-1].recv(65536).startswith(b"HTTP/1.1 ")
                until(lambda: not service.server.server_state.tasks)
        with httpx.Client(trust_env=False, verify=NO_TLS) as client:
            assert client.get(f"{service.url}/healthz").status_code == 200
        for connection in held:
            connection.close()


STARVED = """
import resource, socket, sys
import uvicorn
from specimap_infra.logs import set_up_logs
from specimap_infra.settings import load_settings
from specimap_service.admission import Admission
from specimap_service.app import create_app
from specimap_service.server import server_config

resource.setrlimit(resource.RLIMIT_NOFILE, (int(sys.argv[2]), int(sys.argv[2])))
most = int(sys.argv[3])
settings = load_settings(
    data_dir=sys.argv[1], log_level="error", max_connections=most, max_connections_per_address=most
)
set_up_logs(settings)
listening = socket.create_server(("127.0.0.1", 0))
config = server_config(create_app(settings), settings)
if len(sys.argv) > 4:
    config.http.admission = Admission(1000, 1000)
print(listening.getsockname()[1], flush=True)
uvicorn.Server(config).run(sockets=[listening])
"""


@contextmanager
def starved(folder: Path, *arguments: object) -> Iterator[str]:
    """A service in a process of its own that may open few files."""
    program = [sys.executable, "-c", STARVED, str(folder), *map(str, arguments)]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            url = f"http://127.0.0.1:{process.stdout.readline().strip()}"
            until(lambda: up(url))
            yield url
        finally:
            process.terminate()
            process.communicate(timeout=20)


def up(url: str) -> bool:
    with suppress(httpx.TransportError):
        return httpx.get(f"{url}/healthz", trust_env=False, verify=NO_TLS, timeout=5).status_code == 200
    return False


@pytest.mark.slow
@pytest.mark.parametrize("unlimited", [False, True], ids=["limited", "out of files"])
def test_the_limit_of_open_files_stops_nothing(tmp_path: Path, unlimited: bool) -> None:
    """More connections than files: they are refused; and where the files run out all the same, the service goes on."""
    with starved(tmp_path, 320, 1000, *["unlimited"] * unlimited) as url:
        port = httpx.URL(url).port or 0
        held = []
        for _ in range(500):
            with suppress(OSError):
                held.append(socket.create_connection(("127.0.0.1", port), timeout=5))
        if not unlimited:
            assert up(url)
        for connection in held:
            connection.close()
        until(lambda: up(url), 10)
