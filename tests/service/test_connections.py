"""What a connection may bring before a key is asked for: a head of bounded size, in bounded time."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from specimap_service import connections
from specimap_service.connections import LARGEST_HEAD
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


def connected(service: Running) -> socket.socket:
    url = httpx.URL(service.url)
    return socket.create_connection((url.host, url.port or 80), timeout=30)


def answered(connection: socket.socket) -> bytes:
    """All that comes until the other side ends."""
    output = b""
    try:
        while piece := connection.recv(65536):
            output += piece
    except ConnectionError:
        pass
    return output


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


@pytest.mark.parametrize(
    "sent", [b"", b"GET /healthz HTTP/1.1\r\nHost", b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\nGET /"]
)
def test_a_head_that_does_not_end_is_not_waited_for(
    sent: bytes, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(connections, "HEAD_SECONDS", 0.2)
    with serving(tmp_path) as service, connected(service) as connection:
        connection.sendall(sent)
        assert answered(connection).count(b"HTTP/1.1 200 ") == sent.count(b"\r\n\r\n")
