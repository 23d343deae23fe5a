"""Names of worker processes: ``host:slot:suffix``, new at every start."""

from __future__ import annotations

import socket
import uuid


def new_executor(slot: int) -> str:
    """Make the name of a worker process."""
    return f"{socket.gethostname()}:{slot}:{uuid.uuid4().hex[:12]}"


def suffix_of(executor: str) -> str:
    """Return how the names of an executor's folders end."""
    return executor.rsplit(":", 1)[-1]
