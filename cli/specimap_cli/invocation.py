"""How this program was called, for commands that a person is told to type."""

from __future__ import annotations

import shlex
import shutil
import sys
from pathlib import Path


def program() -> str:
    """Return what to type for this program: its name, or its path where the name alone does not find it."""
    called = Path(sys.argv[0])
    found = shutil.which("specimap")
    if called.name != "specimap" or (found is not None and called.exists() and Path(found).samefile(called)):
        return "specimap"
    return shlex.quote(sys.argv[0])
