"""``python -m bench.faults``: jobs over HTTP while workers, stages and the API are killed at random; none may be lost.

Each kill is ``kill -9`` of one process: of a worker, of a stage's process, of the API, and with ``--machines`` of all
that runs on a machine, at random times from a fixed seed. A takeover is the time from such a death to the next start of
a job that ran there. The stages are the real ones; with ``--stand-in`` others stand in, so that a thousand jobs end
within minutes.
"""

from __future__ import annotations

import os
import sys
import tempfile
from argparse import ArgumentParser
from contextlib import nullcontext
from pathlib import Path

from rich.console import Console

from bench.faults.run import measure
from bench.faults.sheet import sheet_faults
from bench.record import keep
from bench.sample import SAMPLE, run_sample
from bench.service.databases import postgres_url
from specimap_infra.settings import load_settings

STAND_IN = Path(__file__).with_name("stand_in.py")
STAND_IN_SECONDS = 0.2


def main() -> None:
    """Run, print what was found, and keep it; the status is 1 where a job was lost."""
    parser = ArgumentParser(prog="python -m bench.faults", description=__doc__)
    parser.add_argument("--jobs", type=int, default=30)
    parser.add_argument("--slots", type=int, default=2, help="workers, of each machine")
    parser.add_argument("--machines", type=int, default=1, help="with more than one, whole machines are killed too")
    parser.add_argument("--gap", type=float, default=3.0, help="mean seconds between two kills")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=60, help="longest time of kills; then the rest may end")
    parser.add_argument("--postgresql", action="store_true", help="on the server that libpq's variables name")
    parser.add_argument("--photos", type=Path, default=SAMPLE / "rgb")
    parser.add_argument("--cube", type=Path, default=SAMPLE / "hsi" / "hsi.hdr")
    parser.add_argument("--stand-in", action="store_true", help="stages that only leave what the next looks for")
    parser.add_argument("--hogs", type=int, default=0, help="processes that only take processor time, beside")
    options = parser.parse_args()
    given = postgres_url() if options.postgresql else nullcontext("")
    with tempfile.TemporaryDirectory(prefix="specimap-faults-") as folder, given as url:
        os.environ |= {"SPECIMAP_DATA_DIR": f"{folder}/data", "SPECIMAP_LOG_LEVEL": "error"}
        if url:
            os.environ["SPECIMAP_DATABASE_URL"] = url
        command = ""
        if options.stand_in:
            os.environ["SPECIMAP_SANDBOX"] = "off"
            run_sample(Path(folder) / "result")
            command = f"{sys.executable} -I -S {STAND_IN} {folder}/result {STAND_IN_SECONDS}"
        figures = measure(load_settings(), options, command)
    kept = keep("faults", figures)
    sheet_faults([figures]).show(Console(width=None if sys.stdout.isatty() else 150))
    for failure in figures["failures"]:
        print(failure)
    print(f"Kept in {kept}")
    sys.exit(figures["states"] != {"succeeded": options.jobs})


if __name__ == "__main__":
    main()
