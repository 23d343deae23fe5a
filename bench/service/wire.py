"""HTTP/1.1 by hand, so that what is measured is the server: the same client for each.

A client library spends more processor time on a request than the service does, and shares its cores.
"""

from __future__ import annotations

import gc
import re
import selectors
import socket
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

Address = tuple[str, int]
BUFFER = 1 << 20
SILENT_SECONDS = 60
_LENGTH = re.compile(rb"\r\ncontent-length:\s*(\d+)", re.IGNORECASE)


def request(
    address: Address, path: str, headers: Mapping[str, str] | None = None, method: str = "GET", body: bytes = b""
) -> bytes:
    """The bytes of a request. ``body`` may be left to be sent afterwards, where the headers give its length."""
    lines = {"Host": f"{address[0]}:{address[1]}", **(headers or {})}
    if body:
        lines["Content-Length"] = str(len(body))
    head = "".join(f"{name}: {value}\r\n" for name, value in lines.items())
    return f"{method} {path} HTTP/1.1\r\n{head}\r\n".encode() + body


class Connection:
    """One connection, kept between requests."""

    def __init__(self, address: Address) -> None:
        self._socket = socket.create_connection(address, SILENT_SECONDS)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._buffer = bytearray(BUFFER)

    def exchange(self, sent: bytes, file: Path | None = None) -> int:
        """Send a request, and a file as its body; the length of the answer's body, which is dropped.

        Raises RuntimeError for an answer that is no success, or breaks off.
        """
        self._socket.sendall(sent)
        if file is not None:
            with open(file, "rb") as body:
                self._socket.sendfile(body)
        have, view = 0, memoryview(self._buffer)
        while (end := self._buffer.find(b"\r\n\r\n", 0, have)) < 0:
            got = self._socket.recv_into(view[have:])
            if not got:
                raise RuntimeError("the connection was closed before an answer came")
            have += got
        head = bytes(view[:end])
        length = checked_length(head)
        left = length - (have - end - 4)
        while left > 0:
            got = self._socket.recv_into(self._buffer)
            if not got:
                raise RuntimeError(f"the answer broke off {left} bytes before its end")
            left -= got
        return length

    def content(self, sent: bytes) -> bytes:
        """Send a request; the answer's body. Raises as :meth:`exchange`."""
        self._socket.sendall(sent)
        came = b""
        while (end := came.find(b"\r\n\r\n")) < 0 or len(came) < end + 4 + checked_length(came[:end]):
            piece = self._socket.recv(BUFFER)
            if not piece:
                raise RuntimeError("the connection was closed before the answer was whole")
            came += piece
        return came[end + 4 :]

    def close(self) -> None:
        """Close it."""
        self._socket.close()


def checked_length(head: bytes) -> int:
    """Length of a body, from the head of its answer. Raises RuntimeError where that is no success."""
    status, found = head[9:12], _LENGTH.search(head)
    if status[:1] != b"2":
        raise RuntimeError(f"the answer is {head.partition(bytes((13,)))[0].decode('latin-1')}")
    if found is None:
        if status == b"204":
            return 0
        raise RuntimeError("the answer does not say its length")
    return int(found[1])


# ---- many clients -------------------------------------------------------------------------------------


@dataclass
class Load:
    """What many clients saw: seconds of each request, in the order in which they ended; bytes of the answers' bodies;
    seconds of all together."""

    latencies: list[float] = field(default_factory=list)
    received: int = 0
    seconds: float = 0.0

    def as_dict(self) -> dict[str, float]:
        """Requests, their rate, and percentiles in milliseconds."""
        p50, p99 = np.percentile(self.latencies, [50, 99]) * 1e3
        return {
            "requests": len(self.latencies),
            "per_second": round(len(self.latencies) / self.seconds, 1),
            "p50_ms": round(float(p50), 3),
            "p99_ms": round(float(p99), 3),
        }


class _Client:
    def __init__(self, address: Address, turn: int) -> None:
        self.socket = socket.create_connection(address, SILENT_SECONDS)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.turn = turn
        self.started = 0.0
        self.length = 0
        self._head = b""
        self._left = -1

    def ask(self, requests: Sequence[bytes]) -> None:
        """Send the next request."""
        self._head, self._left = b"", -1
        self.turn = (self.turn + 1) % len(requests)
        self.started = time.perf_counter()
        self.socket.sendall(requests[self.turn])

    def hear(self, buffer: bytearray) -> bool:
        """Take what has come; whether the answer is whole."""
        got = self.socket.recv_into(buffer)
        if not got:
            raise RuntimeError("the connection was closed before the answer was whole")
        if self._left < 0:
            self._head += bytes(buffer[:got])
            end = self._head.find(b"\r\n\r\n")
            if end < 0:
                return False
            self.length = checked_length(self._head[:end])
            self._left = self.length - (len(self._head) - end - 4)
        else:
            self._left -= got
        return self._left == 0


def load(address: Address, requests: Sequence[bytes], clients: int, seconds: float) -> Load:
    """``clients`` connections, each of which sends the next request as soon as its answer is whole, for ``seconds``.

    They go through ``requests`` from different places on, again and again. Raises RuntimeError for any answer that
    is no success.
    """
    result, buffer = Load(), bytearray(BUFFER)
    with selectors.DefaultSelector() as selector:
        crowd = [_Client(address, k * len(requests) // clients) for k in range(clients)]
        for client in crowd:
            selector.register(client.socket, selectors.EVENT_READ, client)
        gc.disable()
        try:
            start = time.perf_counter()
            for client in crowd:
                client.ask(requests)
            open_requests = clients
            while open_requests:
                ready = selector.select(SILENT_SECONDS)
                if not ready:
                    raise RuntimeError(f"no answer came for {SILENT_SECONDS} s")
                for key, _ in ready:
                    client = key.data
                    if not client.hear(buffer):
                        continue
                    now = time.perf_counter()
                    result.latencies.append(now - client.started)
                    result.received += client.length
                    if now - start < seconds:
                        client.ask(requests)
                    else:
                        open_requests -= 1
            result.seconds = time.perf_counter() - start
        finally:
            gc.enable()
            for client in crowd:
                client.socket.close()
    return result
