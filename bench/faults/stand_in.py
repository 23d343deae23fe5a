"""A stage's process without the science: ``python -I -S bench/stand_in.py RESULT SECONDS MEMORY PARENT``.

It stands in where a benchmark is about queues and kills: it takes ``SECONDS`` for each stage and leaves what the next
stage looks for, at the last one the finished result in the folder ``RESULT``. It imports next to nothing, since four
of these processes are started for each of a thousand jobs.
"""

import ctypes
import json
import os
import shutil
import signal
import sys
import time

PR_SET_PDEATHSIG = 1


def main() -> None:
    """Serve one stage, as ``specimap_workers.stage_main`` does."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    result, seconds = sys.argv[1], float(sys.argv[2])
    line = sys.stdin.readline()
    if not line:
        return
    spec = json.loads(line)
    stage, out = spec["stage"], spec["out"]
    print(json.dumps({"event": "progress", "stage": stage, "share": 0.0}), flush=True)
    time.sleep(seconds)
    if stage == "register":
        # What was killed may have left a part of it.
        shutil.copytree(result, out, ignore=shutil.ignore_patterns("stages"), dirs_exist_ok=True)
    else:
        os.makedirs(f"{out}/stages", exist_ok=True)
        with open(f"{out}/stages/{stage}-{spec['keys'][stage]}.npz", "wb") as artefact:
            artefact.write(b"an artefact")
    print(json.dumps({"event": "done", "seconds": seconds}), flush=True)


if __name__ == "__main__":
    main()
    os._exit(0)
