"""``python -m specimap_hospital``: the process of the hospital's side.

``specimap hospital`` and ``specimap serve`` start it so.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys

from specimap_core.errors import SettingsError, SpecimapError
from specimap_core.sandbox import hide_from_others
from specimap_core.sandbox.lifetime import die_with
from specimap_core.threads import limit_blas_threads


def main() -> int:
    """Run until SIGINT or SIGTERM; 2 where a setting keeps it from that, 75 where what stops it may pass."""
    limit_blas_threads()
    # Imported after that, since some load numpy.
    from specimap_hospital.connections import check_has_work
    from specimap_infra.confinement import check_confinement
    from specimap_infra.logs import logger, set_up_logs
    from specimap_infra.settings import load_settings

    parser = argparse.ArgumentParser(prog="python -m specimap_hospital")
    parser.add_argument("--parent", type=int, help="process id of the parent, to end when it ends")
    # Given by a supervisor, which names what it starts.
    parser.add_argument("--executor", help=argparse.SUPPRESS)
    parser.add_argument("--slot", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.parent is not None:
        die_with(options.parent)
    try:
        settings = load_settings()
        set_up_logs(settings)
        check_confinement(settings)
        hide_from_others()
        check_has_work(settings)
        from specimap_hospital.process import HospitalProcess

        process = HospitalProcess(settings)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, lambda *_: process.stop())
        process.run()
    except SpecimapError as error:
        logger().error("hospital process cannot work", code=error.code, message=error.message, advice=error.advice)
        return 2 if isinstance(error, SettingsError) else os.EX_TEMPFAIL
    return 0


if __name__ == "__main__":
    status = main()
    sys.stderr.flush()
    # Threads that wait for a server that is away would hold up the end of the interpreter.
    os._exit(status)
