"""A load balancer without sticky routing: each connection goes to the next server that takes it."""

from __future__ import annotations

import socket
import threading
from collections.abc import Sequence
from contextlib import suppress


class RoundRobin:
    """Listens at ``url``; its ``servers`` are addresses like ``http://127.0.0.1:8000``, and may be exchanged."""

    def __init__(self, servers: Sequence[str]) -> None:
        self.servers = list(servers)
        self.sent: list[str] = []
        """The server of each connection, in order."""
        self._turn = 0
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.url = f"http://127.0.0.1:{self._listening.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                here, _ = self._listening.accept()
                there = self._next()
                if there is None:
                    here.close()
                    continue
                threading.Thread(target=_join, args=(here, there), daemon=True).start()

    def _next(self) -> socket.socket | None:
        for _ in self.servers:
            server = self.servers[self._turn % len(self.servers)]
            self._turn += 1
            with suppress(OSError):
                there = socket.create_connection(("127.0.0.1", int(server.rsplit(":", 1)[1])), 5)
                there.settimeout(None)
                self.sent.append(server)
                return there
        return None

    def close(self) -> None:
        """Take no more connections."""
        with suppress(OSError):
            self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()


def _join(here: socket.socket, there: socket.socket) -> None:
    back = threading.Thread(target=_pass_on, args=(there, here), daemon=True)
    back.start()
    _pass_on(here, there)
    back.join()
    # Closed by one thread while the other reads, its number could be another connection's by then.
    for end in (here, there):
        end.close()


def _pass_on(source: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while piece := source.recv(65536):
            target.sendall(piece)
    with suppress(OSError):
        target.shutdown(socket.SHUT_WR)
