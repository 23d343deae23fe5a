"""Whether the workers of this machine, or of this container, live: what a container's health check asks.

The answer comes from the notes that workers keep on the local disk, not from the database: while that is away, workers
wait for it, and an orchestrator that ended them would only lose the stages that run.
"""

from __future__ import annotations

import socket
import time
from dataclasses import dataclass

from specimap_infra.settings import ServiceSettings
from specimap_workers.presence import living

SILENT_LEASES = 9
"""A worker is silent after so many times ``lease_seconds``: one attempt at a database that hangs may take 30 s."""


@dataclass(frozen=True)
class Health:
    """Names of the workers that have shown a sign of life of late, and of those that live and have not."""

    lively: tuple[str, ...]
    silent: tuple[str, ...]

    @property
    def sound(self) -> bool:
        """Whether a worker lives, and none has fallen silent."""
        return bool(self.lively) and not self.silent


def workers_here(settings: ServiceSettings, host: str | None = None) -> Health:
    """Judge the workers of a host (by default this one) by their notes in the scratch folder."""
    host = host or socket.gethostname()
    notes = {executor: beat for executor, beat in living(settings.scratch / "work") if executor.startswith(f"{host}:")}
    oldest = time.time() - SILENT_LEASES * settings.lease_seconds
    return Health(
        tuple(sorted(executor for executor, beat in notes.items() if beat >= oldest)),
        tuple(sorted(executor for executor, beat in notes.items() if beat < oldest)),
    )
