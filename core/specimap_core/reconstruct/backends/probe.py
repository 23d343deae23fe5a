"""What interpreters can import, and what this machine has: cores and GPUs.

Nothing heavy is imported here: interpreters are asked in processes of their own, since a user may have named others
than this one, and importing a network's libraries takes seconds.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

from specimap_core.sandbox.process import child_environment

PROBE_SECONDS = 60.0
IMPORTED = ("numpy", "cv2", "pycolmap", "embreex", "torch", "torchvision")
"""Modules that are imported, not only found: those whose native parts are known to be missing something or not to fit
one another."""

PROBE = """
import importlib, importlib.util, json, sys
found, facts = {}, {}
for name in sys.argv[1].split(","):
    try:
        if name == "open3d":
            from specimap_core.native import open3d
            found[name] = getattr(open3d(), "__version__", "")
        elif name not in sys.argv[2].split(","):
            # Finding takes no time; importing all of them would take many seconds.
            if importlib.util.find_spec(name) is None:
                raise ImportError("not installed")
            found[name] = ""
        else:
            found[name] = str(getattr(importlib.import_module(name), "__version__", ""))
    except BaseException as error:
        facts.setdefault("missing", {})[name] = (str(error) or type(error).__name__).splitlines()[0][:300]
if "torch" in found:
    import torch
    facts["gpus"] = [
        {"name": p.name, "memory_bytes": p.total_memory}
        for p in map(torch.cuda.get_device_properties, range(torch.cuda.device_count()))
    ] if torch.cuda.is_available() else []
print("\\n" + json.dumps({"modules": found, **facts}))
"""


def cpu_count() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def probe(python: str, modules: tuple[str, ...]) -> dict[str, Any]:
    """What an interpreter can import: ``modules`` with their versions, ``missing`` with the reason, ``gpus`` of its
    torch; ``failed`` where it does not run."""
    environment = child_environment(Path.cwd(), {})
    environment.pop("TMPDIR")
    try:
        done = subprocess.run(  # noqa: S603 - the interpreter that the settings of backends name
            [python, "-c", PROBE, ",".join(modules), ",".join(IMPORTED)],
            capture_output=True,
            text=True,
            timeout=PROBE_SECONDS,
            env=environment,
            stdin=subprocess.DEVNULL,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return {"modules": {}, "failed": str(error)}
    try:
        found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    except (ValueError, IndexError):
        return {"modules": {}, "failed": (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]}
    return found


def driver_gpus() -> tuple[dict[str, Any], ...]:
    """GPUs as NVIDIA's driver tells; none where there is no driver."""
    if shutil.which("nvidia-smi") is None:
        return ()
    try:
        done = subprocess.run(
            # Wherever the driver has put it.
            ["nvidia-smi", "--query-gpu=name,memory.total,driver_version", "--format=csv,noheader,nounits"],  # noqa: S607
            capture_output=True,
            text=True,
            timeout=PROBE_SECONDS,
            check=True,
        )
        rows = [[cell.strip() for cell in line.rsplit(",", 2)] for line in done.stdout.splitlines() if line.strip()]
        return tuple({"name": name, "memory_bytes": int(mib) * 1024**2, "driver": driver} for name, mib, driver in rows)
    except (OSError, ValueError, subprocess.SubprocessError):
        return ()
