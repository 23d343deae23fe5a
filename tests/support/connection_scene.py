"""Connections without a client library."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import httpx

from tests.support.service_scene import Running

ASKED = b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n"


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


def until(condition: Callable[[], bool], seconds: float = 15) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come about"
        time.sleep(0.02)
