"""``python -m specimap.workers``: one worker, for one slot; ``specimap worker`` and ``specimap serve`` start it so."""

from __future__ import annotations

import argparse
import shlex
import sys

from specimap.core.errors import SpecimapError
from specimap.core.sandbox import hide_from_others
from specimap.infra.database import Database
from specimap.infra.logs import logger, set_up_logs
from specimap.infra.migrate import migrate
from specimap.infra.settings import load_settings
from specimap.workers.processes import COMMAND
from specimap.workers.stage_main import die_with


def main() -> int:
    """Run a worker until it is stopped; 2 where it cannot start."""
    parser = argparse.ArgumentParser(prog="python -m specimap.workers")
    parser.add_argument("--slot", type=int, default=0)
    parser.add_argument("--kind", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--parent", type=int, help="process id of the parent, to end when it ends")
    parser.add_argument("--stage-command", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.parent is not None:
        die_with(options.parent)
    try:
        settings = load_settings()
        set_up_logs(settings)
        hide_from_others()
        database = Database.open(settings.database)
        migrate(database)
        database.close()
        # Its imports are the slow ones: a wrong setting is told before them.
        from specimap.workers.worker import Worker

        command = shlex.split(options.stage_command) if options.stage_command else COMMAND
        Worker(settings, slot=options.slot, kind=options.kind, command=command).run()
    except SpecimapError as error:
        logger().error("worker cannot work", code=error.code, message=error.message, advice=error.advice)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
