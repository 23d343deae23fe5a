"""A stage's own process: waits for one stage on standard input, runs it, reports its progress on standard output.

A process for each stage keeps the worker's heartbeats off the interpreter lock, gives memory back for certain, and
can be killed at any time. It loads the libraries before the stage comes, so that a stage finds it warm.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
from pathlib import Path
from typing import Any, TextIO

from specimap_core.sandbox.lifetime import die_with
from specimap_core.threads import limit_blas_threads


def _send(out: TextIO, **event: object) -> None:
    # Imported late, since it loads numpy.
    from specimap_core.json_text import json_text

    out.write(json_text(event) + "\n")
    out.flush()


def _load() -> None:
    """Import what the stages need: most of a second."""
    import specimap_core.pipeline.register_stage
    import specimap_core.pipeline.single_stage
    import specimap_core.pipeline.stages  # noqa: F401
    from specimap_core.native import preload

    preload()


def _run(spec: dict[str, Any], out: TextIO) -> None:
    from specimap_core.pipeline.options import RunOptions
    from specimap_core.pipeline.outputs import Inputs
    from specimap_core.pipeline.settings import settings_from
    from specimap_core.pipeline.single_stage import StageRun, run_stage
    from specimap_core.reconstruct.backends.environment import backends_from

    options = RunOptions(**spec["settings"])
    backends = backends_from(os.environ, options.backend)
    paths = {name: Path(path) for name, path in spec["inputs"].items()}
    run = StageRun(
        spec["stage"],
        Inputs(**paths),
        Path(spec["out"]),
        settings_from(options, backends.device),
        spec["keys"],
        spec["seconds"],
        spec["reused"],
        spec["hashes"],
        spec["workers"],
        backends,
    )
    seconds = run_stage(run, progress=lambda stage, share: _send(out, event="progress", stage=stage, share=share))
    _send(out, event="done", seconds=seconds)


def main() -> None:
    """Serve one stage. Arguments: the most address space it may take, 0 for any, and the parent's process id."""
    limit_blas_threads()
    memory_bytes, parent = (int(value) for value in sys.argv[1:3])
    die_with(parent)
    # Libraries that print must not get between the lines that the worker reads.
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if memory_bytes:
        resource.setrlimit(resource.RLIMIT_AS, (memory_bytes, memory_bytes))
    _load()
    _send(out, event="ready")
    line = sys.stdin.readline()
    if not line:
        return
    from specimap_core.errors import SpecimapError, StorageFullError

    try:
        _run(json.loads(line), out)
    except SpecimapError as error:
        _send(out, event="failed", error=error.as_dict())
    except OSError as error:
        if error.errno != 28:
            raise
        full = StorageFullError("The disk filled up.", advice="Free space; finished stages are kept.")
        _send(out, event="failed", error=full.as_dict())


if __name__ == "__main__":
    main()
    # Native libraries' threads may block the interpreter's end; all results are on the disk.
    sys.stdout.flush()
    os._exit(0)
