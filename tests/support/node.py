"""Node, and npm packages of tests, from lock files of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

NODE = str(Path(sys.executable).parent / "node")


def npm_packages(folder: Path) -> None:
    """Install the packages of ``folder``'s lock file, unless they are there; processes that want them wait in turn."""
    import fcntl

    done = folder / "node_modules" / ".installed"
    lock = folder / "package-lock.json"
    with lock.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        if done.is_file() and done.stat().st_mtime >= lock.stat().st_mtime:
            return
        path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
        subprocess.run(
            ["npm", "ci", "--loglevel", "error"], cwd=folder, env={**os.environ, "PATH": path}, check=True, timeout=300
        )
        done.touch()
