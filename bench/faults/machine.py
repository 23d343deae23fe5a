"""``python -m bench.faults.machine SLOTS STAGE_COMMAND``: workers with a supervisor, as of ``specimap worker``."""

from __future__ import annotations

import signal
import sys
from contextlib import suppress

from specimap_infra.logs import set_up_logs
from specimap_infra.settings import load_settings
from specimap_workers.reaper import burier
from specimap_workers.supervisor import Supervisor


def _stop(*_: object) -> None:
    raise KeyboardInterrupt


def main() -> None:
    """Work until SIGTERM."""
    slots, command = int(sys.argv[1]), sys.argv[2]
    settings = load_settings()
    set_up_logs(settings)
    supervisor = Supervisor(slots, ("--stage-command", command) if command else (), burier(settings))
    signal.signal(signal.SIGTERM, _stop)
    supervisor.start()
    with suppress(KeyboardInterrupt):
        supervisor.wait()
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    supervisor.stop()


if __name__ == "__main__":
    main()
