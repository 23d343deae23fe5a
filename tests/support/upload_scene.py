"""What the tests of uploads share: acquisitions, plain tus requests, a server of its own, a network that breaks."""

from __future__ import annotations

import base64
import os
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from specimap_infra.database import Database
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import load_settings
from specimap_service.auth.keys import new_key
from tests.support.databases import create_tables
from tests.support.places import SAMPLES
from tests.support.plain_http import NO_TLS

TUS = {"Tus-Resumable": "1.0.0"}
OCTETS = "application/offset+octet-stream"

SERVER = """
import json, resource, socket, sys
import uvicorn
from specimap_infra.logs import set_up_logs
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import load_settings
from specimap_service.app import create_app
from specimap_service.server import server_config

given = json.loads(sys.argv[1])
limit = given.pop("largest_file", 0)
settings = load_settings(**given)
set_up_logs(settings)
app = create_app(settings)
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
listening = socket.create_server(("127.0.0.1", 0))
print(listening.getsockname()[1], flush=True)
uvicorn.Server(server_config(app, settings)).run(sockets=[listening])
"""


def photos() -> list[Path]:
    """The sample's photos."""
    return sorted((SAMPLES / "rgb").glob("*.jpg"))


def new_acquisition(client: httpx.Client, **fields: object) -> str:
    answer = client.post("/v1/acquisitions", json={"specimen_id": "SP-1", **fields})
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


def send(client: httpx.Client, acquisition: str, role: str, name: str, data: bytes) -> httpx.Response:
    """One file in a form."""
    return client.post(f"/v1/acquisitions/{acquisition}/files", data={"role": role}, files={"file": (name, data)})


def sent(client: httpx.Client, acquisition: str, role: str, name: str, data: bytes) -> dict[str, Any]:
    """One file in a form, as the API then shows it."""
    answer = send(client, acquisition, role, name, data)
    assert answer.status_code == 201, answer.text
    (file,) = answer.json()
    return dict(file)


def metadata(**fields: str) -> str:
    return ",".join(f"{key} {base64.b64encode(value.encode()).decode()}" for key, value in fields.items())


def create(
    client: httpx.Client, acquisition: str, role: str, size: int, name: str = "x", **headers: str
) -> httpx.Response:
    fields = metadata(acquisition=acquisition, role=role, filename=name)
    return client.post("/v1/uploads", headers={**TUS, "Upload-Length": str(size), "Upload-Metadata": fields, **headers})


def created(client: httpx.Client, acquisition: str, role: str, size: int, name: str = "x") -> str:
    """Address of a new upload."""
    answer = create(client, acquisition, role, size, name)
    assert answer.status_code == 201, answer.text
    return answer.headers["Location"]


def patch(client: httpx.Client, at: str, data: Any, offset: int, **headers: str) -> httpx.Response:
    given = {**TUS, "Upload-Offset": str(offset), "Content-Type": OCTETS, **headers}
    return client.patch(at, content=data, headers=given)


def offset_of(client: httpx.Client, at: str) -> int:
    answer = client.head(at, headers=TUS)
    assert answer.status_code == 200, answer.status_code
    assert "content-length" not in answer.headers
    return int(answer.headers["Upload-Offset"])


def result(client: httpx.Client, at: str) -> dict[str, Any]:
    answer = client.get(f"{at}/result")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


# ---- a server of its own ------------------------------------------------------------------------------


@contextmanager
def process_serving(folder: Path, **given: Any) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """An API process and its address; killed at the end. ``largest_file`` limits what it can write to one file."""
    import json

    settings = {"data_dir": str(folder), "min_free_bytes": 0, "log_level": "error", **given}
    database = Database.open(load_settings(data_dir=folder).database)
    create_tables(database)
    database.close()
    process = subprocess.Popen(
        [sys.executable, "-c", SERVER, json.dumps(settings)],
        stdout=subprocess.PIPE,
        text=True,
        env={k: v for k, v in os.environ.items() if not k.startswith("SPECIMAP_")},
    )
    try:
        assert process.stdout is not None
        port = int(process.stdout.readline())
        yield process, f"http://127.0.0.1:{port}"
    finally:
        process.kill()
        process.wait()
        assert process.stdout is not None
        process.stdout.close()


def key_in(folder: Path) -> str:
    """A key with all scopes, in the database of a folder that no server serves yet."""
    database = Database.open(load_settings(data_dir=folder).database)
    create_tables(database)
    row, key = new_key("test", ("upload", "read", "admin"), project_id=DEFAULT_PROJECT)
    with database.session() as session:
        session.add(row)
    database.close()
    return key


def client_at(url: str, key: str, headers: Mapping[str, str] | None = None) -> httpx.Client:
    return httpx.Client(
        base_url=url,
        headers={"Authorization": f"Bearer {key}", **(headers or {})},
        timeout=60,
        trust_env=False,
        verify=NO_TLS,
    )


# ---- a network that breaks ----------------------------------------------------------------------------


class BreakingProxy:
    """Passes connections on to a server; each of the first ``breaks`` is cut after a random number of bytes."""

    def __init__(self, url: str, breaks: int, most_bytes: int, seed: int) -> None:
        self._target = ("127.0.0.1", int(url.rsplit(":", 1)[1]))
        rng = random.Random(seed)
        self._budgets = [rng.randint(most_bytes // 10, most_bytes) for _ in range(breaks)]
        self._hard = [rng.random() < 0.5 for _ in range(breaks)]
        self.cut = 0
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                here, _ = self._listening.accept()
                there = socket.create_connection(self._target)
                self._threads.append(threading.Thread(target=self._pass_on, args=(here, there), daemon=True))
                self._threads[-1].start()

    def _pass_on(self, here: socket.socket, there: socket.socket) -> None:
        back = threading.Thread(target=self._pump, args=(there, here, None), daemon=True)
        back.start()
        self._pump(here, there, self)
        back.join()
        # Closed by one thread while the other reads, its number could be another connection's by then.
        for end in (here, there):
            end.close()

    def _pump(self, source: socket.socket, target: socket.socket, counted: BreakingProxy | None) -> None:
        passed = 0
        with suppress(OSError):
            while piece := source.recv(65536):
                target.sendall(piece)
                passed += len(piece)
                if counted is not None and self.cut < len(self._budgets) and passed > self._budgets[self.cut]:
                    if self._hard[self.cut]:
                        for end in (source, target):
                            end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                    self.cut += 1
                    break
        for end in (source, target):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for thread in self._threads:
            thread.join(timeout=10)


def noise(size: int) -> bytes:
    """Bytes that are the same each time and compress to nothing less."""
    return np.random.default_rng(0).bytes(size)


def begun(url: str, at: str, key: str, data: bytes, offset: int, upto: int) -> socket.socket:
    """A connection on which a PATCH of all that is missing was begun, and no more comes."""
    lines = {
        **TUS,
        "Host": "x",
        "Authorization": f"Bearer {key}",
        "Upload-Offset": str(offset),
        "Content-Type": OCTETS,
        "Content-Length": str(len(data) - offset),
    }
    head = f"PATCH {at} HTTP/1.1\r\n" + "".join(f"{k}: {v}\r\n" for k, v in lines.items()) + "\r\n"
    connection = socket.create_connection(("127.0.0.1", int(url.rsplit(":", 1)[1])))
    try:
        connection.sendall(head.encode() + data[offset:upto])
    except BaseException:
        connection.close()
        raise
    return connection


def until_offset(client: httpx.Client, at: str, least: int) -> int:
    """The upload's offset once it is ``least`` or more."""
    deadline = time.monotonic() + 30
    while (offset := offset_of(client, at)) < least:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return offset
