"""What a connection may bring before a key is asked for, and how long it may take."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from specimap_service.connections import LARGEST_HEAD
from tests.support.connection_scene import ASKED, answered, connected, until
from tests.support.result_scene import put_result
from tests.support.service_scene import Running, serving

PIECE = b"a" * 16384


ENDLESS = {
    "line": b"GET /",
    "header": b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: ",
    "header's name": b"GET /healthz HTTP/1.1\r\nHost: x\r\nX",
    "size of a chunk": b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n1;",
    "header after the body": b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n0\r\nX: ",
    "second head": b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\nGET /healthz HTTP/1.1\r\nX: ",
}


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with serving(tmp_path_factory.mktemp("connections")) as running:
        yield running


@pytest.mark.parametrize("what", ENDLESS)
def test_nothing_endless_is_gathered(shared: Running, what: str) -> None:
    sent = 0
    with connected(shared) as connection:
        connection.sendall(ENDLESS[what])
        try:
            while sent < 64 << 20:
                connection.sendall(PIECE)
                sent += len(PIECE)
        except ConnectionError:
            pass
    # The rest of it lay in buffers of the system.
    assert sent < 16 << 20


def test_the_refusal_says_why(shared: Running) -> None:
    with connected(shared) as connection:
        connection.sendall(ENDLESS["header"])
        for piece in (*[PIECE] * (LARGEST_HEAD // len(PIECE)), b"a"):
            time.sleep(0.05)
            connection.sendall(piece)
        output = answered(connection)
    assert output.startswith(b"HTTP/1.1 400 ")
    assert output.endswith(b"The request's headers are too large.")


def test_an_honest_head_is_read_however_it_comes(shared: Running) -> None:
    head = b"GET /healthz HTTP/1.1\r\nHost: x\r\nX: " + b"a" * (LARGEST_HEAD // 2) + b"\r\n\r\n"
    with connected(shared) as connection:
        for _ in range(4):
            for start in range(0, len(head), 5000):
                connection.sendall(head[start : start + 5000])
                time.sleep(0.002)
            assert connection.recv(65536).startswith(b"HTTP/1.1 200 ")


def test_a_body_may_come_in_any_pieces(shared: Running) -> None:
    with connected(shared) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\nTransfer-Encoding: chunked\r\n\r\n")
        # The sizes alone are more than a head may have.
        for _ in range(LARGEST_HEAD // 1000 + 40):
            connection.sendall(b"1;" + b"e" * 1000 + b"\r\n")
            time.sleep(0.001)
            connection.sendall(b"x\r\n")
        connection.sendall(b"0\r\nX-After: y\r\n\r\nGET /healthz HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        assert answered(connection).count(b"HTTP/1.1 200 ") == 2


QUICK: dict[str, Any] = {"head_seconds": 0.3, "keep_alive_seconds": 0.3, "silence_seconds": 0.4}


PIPELINED = b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n"


UNENDED: dict[str, tuple[bytes, ...]] = {
    "nothing": (b"",),
    "half a head": (b"GET /healthz HTTP/1.1\r\nHost",),
    "half of the second head": (ASKED + b"GET /",),
    "nothing after an answer": (ASKED,),
    "half a head after an answer": (ASKED, b"GET /"),
    "empty lines": (ASKED, b"\r\n"),
    "no body": (b"GET /healthz HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n",),
    "half a body after the answer": (b"GET /healthz HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n", b"1"),
    "half a body without a key": (b"POST /v1/jobs HTTP/1.1\r\nHost: x\r\nContent-Length: 9\r\n\r\n", b"1"),
}


@pytest.fixture(scope="module")
def quick(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with serving(tmp_path_factory.mktemp("quick"), **QUICK) as running:
        yield running


@pytest.mark.parametrize("what", UNENDED)
def test_no_client_is_waited_for_without_end(quick: Running, what: str) -> None:
    pieces = UNENDED[what]
    with connected(quick) as connection:
        output = b""
        for piece in pieces:
            connection.sendall(piece)
            if piece is not pieces[-1]:
                output += connection.recv(65536)
        output += answered(connection)
    assert output.count(b"HTTP/1.1 200 ") == b"".join(pieces).count(b"GET /healthz HTTP/1.1\r\nHost: x\r\n")


def test_a_head_that_trickles_is_not_waited_for(quick: Running) -> None:
    with connected(quick) as connection:
        connection.sendall(b"GET /healthz HTTP/1.1\r\nX: ")
        sent = 0
        with suppress(ConnectionError):
            while sent < 200:
                sent += connection.send(b"a")
                time.sleep(0.05)
    assert sent < 200


@pytest.mark.parametrize("path", ["/v1/acquisitions", "/v1/acquisitions/{}/files"])
@pytest.mark.parametrize("trickles", [False, True])
def test_a_body_that_stops_is_refused_quietly(
    quick: Running, path: str, trickles: bool, capfd: pytest.CaptureFixture[str]
) -> None:
    client = quick.client()
    acquisition = client.post("/v1/acquisitions", json={"specimen_id": "S"}).json()["id"]
    key = client.headers["Authorization"]
    head = (
        f"POST {path.format(acquisition)} HTTP/1.1\r\nHost: x\r\nAuthorization: {key}\r\n"
        "Content-Type: multipart/form-data; boundary=x\r\nContent-Length: 9000\r\n\r\n--x\r\n"
    )
    with connected(quick) as connection:
        connection.sendall(head.encode())
        if trickles:
            with suppress(ConnectionError):
                for _ in range(20):
                    connection.sendall(b"a")
                    time.sleep(0.05)
        output = answered(connection)
    assert output.startswith(b"HTTP/1.1 408 ") or trickles
    if not trickles:
        assert b'"code":"request_timeout"' in output
        assert b"connection: close" in output
    assert "Traceback" not in capfd.readouterr().err


CUT = {
    "JSON": ("POST", "/v1/acquisitions", "Content-Type: application/json"),
    "selection": ("POST", "/v1/clouds/{cloud}/spectra", "Content-Type: application/json"),
    "form": ("POST", "/v1/acquisitions/{acquisition}/files", "Content-Type: multipart/form-data; boundary=x"),
    "labels": ("PUT", "/v1/clouds/{cloud}/labels/x", 'Content-Type: application/x-npy\r\nX-Specimap-Label: {{"kind": '
    '"probability", "made_by": {{"name": "x"}}}}'),
}  # fmt: skip


@pytest.mark.parametrize("what", CUT)
def test_a_client_that_goes_away_is_no_failure(
    shared: Running, tmp_path: Path, what: str, capfd: pytest.CaptureFixture[str]
) -> None:
    client = shared.client()
    acquisition = client.post("/v1/acquisitions", json={"specimen_id": "S"}).json()["id"]
    cloud = put_result(shared, tmp_path / "result").cloud_id if "cloud" in CUT[what][1] else ""
    method, path, headers = (text.format(acquisition=acquisition, cloud=cloud) for text in CUT[what])
    key = client.headers["Authorization"]
    before = set(shared.settings.scratch.rglob("*"))
    with connected(shared) as connection:
        connection.sendall(
            f"{method} {path} HTTP/1.1\r\nHost: x\r\nAuthorization: {key}\r\n{headers}\r\n"
            "Content-Length: 9000\r\n\r\n--x\r\n".encode()
        )
        until(lambda: bool(shared.server.server_state.tasks))
        time.sleep(0.1)
    until(lambda: not shared.server.server_state.tasks)
    assert capfd.readouterr() == ("", "")
    assert "500" not in "".join(line for line in client.get("/metrics").text.splitlines() if 'status="5' in line)
    assert set(shared.settings.scratch.rglob("*")) == before


def test_a_body_that_goes_on_takes_as_long_as_it_takes(quick: Running) -> None:
    key = quick.client().headers["Authorization"]
    body = b'{"specimen_id": "S", "notes": "' + b"n" * 1500 + b'"' + b" " * 12_000 + b"}"
    head = f"POST /v1/acquisitions HTTP/1.1\r\nHost: x\r\nAuthorization: {key}\r\nContent-Type: application/json\r\n"
    with connected(quick) as connection:
        connection.sendall(head.encode() + b"Connection: close\r\nContent-Length: %d\r\n\r\n" % len(body))
        for start in range(0, len(body), 1200):
            connection.sendall(body[start : start + 1200])
            time.sleep(0.1)
        assert answered(connection).startswith(b"HTTP/1.1 201 ")


@pytest.mark.parametrize("trickles", [False, True])
def test_an_answer_that_nobody_reads_is_given_up(quick: Running, trickles: bool) -> None:
    """The answers are more than the buffers of the system hold."""
    with connected(quick) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with suppress(ConnectionError):
            connection.settimeout(0.2)
            for _ in range(100):
                try:
                    connection.sendall(PIPELINED)
                except TimeoutError:
                    break
        deadline = time.monotonic() + 15
        while quick.connections:
            assert time.monotonic() < deadline, "the connection lives on"
            if trickles:
                with suppress(OSError):
                    connection.recv(1)
            time.sleep(0.05)


def test_long_work_is_not_cut_off(tmp_path: Path) -> None:
    """Nothing is owed by a client that waits for its answer."""
    with serving(tmp_path, **QUICK) as service:

        @service.app.get("/long")
        async def long() -> str:
            await asyncio.sleep(1.5)
            return "done"

        with connected(service) as connection:
            connection.sendall(b"GET /long HTTP/1.1\r\nHost: x\r\n\r\n")
            assert connection.recv(65536).endswith(b'"done"')
