"""``python -m specimap_workers``: one worker, for one slot; ``specimap worker`` and ``specimap serve`` start it so."""

from __future__ import annotations

import argparse
import os
import shlex
import sys

from specimap_core.errors import SpecimapError
from specimap_core.sandbox import hide_from_others
from specimap_core.sandbox.lifetime import die_with
from specimap_core.threads import limit_blas_threads


def main() -> int:
    """Run a worker until it is stopped; 2 where a setting keeps it from that, 75 where what stops it may pass."""
    limit_blas_threads()
    # Imported after that, since some load numpy.
    from specimap_core.reconstruct.backends.environment import backends_from
    from specimap_infra.logs import logger, set_up_logs
    from specimap_infra.settings import load_settings
    from specimap_workers.executors import new_executor
    from specimap_workers.patience import PASSING, at_start
    from specimap_workers.stage_process import COMMAND

    parser = argparse.ArgumentParser(prog="python -m specimap_workers")
    parser.add_argument("--slot", type=int, default=0)
    parser.add_argument("--kind", choices=("cpu", "gpu"), default="cpu")
    parser.add_argument("--parent", type=int, help="process id of the parent, to end when it ends")
    parser.add_argument("--executor", help="name of this process, new at every start")
    parser.add_argument("--stage-command", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.parent is not None:
        die_with(options.parent)
    try:
        settings = load_settings()
        set_up_logs(settings)
        hide_from_others()
        # Its imports are the slow ones: a wrong setting is reported before them.
        from specimap_workers.worker import Worker

        executor = options.executor or new_executor(options.slot)
        command = shlex.split(options.stage_command) if options.stage_command else COMMAND
        worker = at_start()(
            Worker.ready, settings, backends_from(os.environ), executor, kind=options.kind, command=command
        )
        worker.run()
    except SpecimapError as error:
        logger().error("worker cannot work", code=error.code, message=error.message, advice=error.advice)
        return os.EX_TEMPFAIL if isinstance(error, PASSING) else 2
    return 0


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    # Threads that wait for a database or a storage that is away would hold up the end of the interpreter.
    os._exit(status)
