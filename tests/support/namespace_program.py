"""Run a program in a network namespace of its own, with ways in and back; a script, started by ``unshare``.

A program that listens on every address is reached by nobody there, but through the sockets that this script is given:
a socket belongs to the namespace in which it was made, so one that was made outside lets connections in.
"""

from __future__ import annotations

import ctypes
import fcntl
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
from contextlib import suppress

_SIOCSIFFLAGS, _IFF_UP, _PR_SET_PDEATHSIG = 0x8914, 1, 1
_PIECE = 1 << 16


def raise_loopback() -> None:
    """Bring up the namespace's own loopback, without the program ``ip``."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        fcntl.ioctl(own, _SIOCSIFFLAGS, struct.pack("16sh14x", b"lo", _IFF_UP))


def forward(listening: socket.socket, port: int) -> None:
    """Connect each connection that arrives at ``listening`` with a port of this process's loopback. Ends with it."""
    while True:
        try:
            arrived, _ = listening.accept()
        except OSError:
            return
        threading.Thread(target=_join, args=(arrived, port), daemon=True).start()


def _join(arrived: socket.socket, port: int) -> None:
    with arrived:
        try:
            inner = socket.create_connection(("127.0.0.1", port), timeout=10)
        except OSError:
            return
        with inner:
            inner.settimeout(None)
            back = threading.Thread(target=_pump, args=(inner, arrived), daemon=True)
            back.start()
            _pump(arrived, inner)
            back.join()


def _pump(source: socket.socket, target: socket.socket) -> None:
    with suppress(OSError):
        while piece := source.recv(_PIECE):
            target.sendall(piece)
    with suppress(OSError):
        target.shutdown(socket.SHUT_WR)
    with suppress(OSError):
        source.shutdown(socket.SHUT_RD)


def end_with_parent() -> None:
    """End when the process that started this one does."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)


def main() -> None:
    """``plan``: ``inward``, pairs of a socket's descriptor and a port inside; ``outward``: ports that are listened on
    inside, whose sockets go back through the descriptor ``control``; ``command``."""
    plan = json.loads(sys.argv[1])
    end_with_parent()
    raise_loopback()
    control = socket.socket(fileno=plan["control"])
    for port in plan["outward"]:
        way_back = socket.create_server(("127.0.0.1", port))
        socket.send_fds(control, [b"."], [way_back.fileno()])
    for descriptor, port in plan["inward"]:
        threading.Thread(target=forward, args=(socket.socket(fileno=descriptor), port), daemon=True).start()
    program = subprocess.Popen(plan["command"], stdin=subprocess.DEVNULL, preexec_fn=end_with_parent)
    os._exit(program.wait() & 0xFF)


if __name__ == "__main__":
    main()
