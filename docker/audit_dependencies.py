"""Ask whether a package of a release has a known weakness: `make audit-dependencies`.

The package index is asked about the Python packages of the lock files, npm's registry about those of the web pages. A
mirror often has no such data. What could not be asked is named, and never counts as sound:

exit status 0: all were asked, none has a known weakness; 1: some have; 3: none is known, and some could not be asked.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
WEAK, NOT_ASKED = 1, 3
SECONDS = 900


def main() -> int:
    """Ask, and say what came of it."""
    weak: list[str] = []
    unasked: list[str] = []
    for found, missed in (python_packages(), page_packages()):
        weak += found
        unasked += missed
    for line in weak:
        print(f"WEAK       {line}")
    for line in unasked:
        print(f"NOT ASKED  {line}")
    if weak:
        print(f"{len(weak)} known weaknesses.")
        return WEAK
    if unasked:
        print(
            "No weakness is known, but not all could be asked about. This is no proof: ask where the data can be had."
        )
        return NOT_ASKED
    print("No package has a known weakness.")
    return 0


def python_packages() -> tuple[list[str], list[str]]:
    """Weaknesses, and what could not be asked, of the lock files' packages."""
    lines = "".join(file.read_text("utf-8") for file in sorted(ROOT.glob("requirements*.lock")))
    pins = sorted({line for line in lines.splitlines() if line[:1] not in ("", "#", "-")})
    with tempfile.NamedTemporaryFile("w", suffix=".txt", encoding="utf-8") as file:
        file.write("\n".join(pins) + "\n")
        file.flush()
        options = ["--no-deps", "--disable-pip", "--vulnerability-service", "pypi", "--format", "json"]
        answer, error = _json([str(BIN / "pip-audit"), "--requirement", file.name, *options])
    return judge_python(answer, error, len(pins))


def judge_python(answer: Any, error: str, packages: int) -> tuple[list[str], list[str]]:
    """Read what pip-audit said: a package that it passes over counts as not asked about."""
    if not isinstance(answer, dict) or len(answer.get("dependencies", [])) != packages:
        return [], [f"Python: pip-audit gave no answer for {packages} packages: {error}"]
    weak, unasked = [], []
    for each in answer["dependencies"]:
        if "skip_reason" in each:
            unasked.append(each["name"])
        for one in each.get("vulns", []):
            mended = ", ".join(one.get("fix_versions", [])) or "no release yet"
            weak.append(f"{each['name']} {each['version']}: {one['id']} (mended in {mended})")
    return weak, [f"Python: {len(unasked)} of {packages} packages: {', '.join(unasked)}"] if unasked else []


def page_packages() -> tuple[list[str], list[str]]:
    """Weaknesses, and what could not be asked, of the web pages' packages."""
    npm = [str(BIN / "npm"), "--prefix", str(ROOT / "web"), "--loglevel", "error"]
    return judge_pages(*_json([*npm, "audit", "--package-lock-only", "--audit=true", "--json"]))


def judge_pages(answer: Any, error: str) -> tuple[list[str], list[str]]:
    """Read what npm said."""
    if not isinstance(answer, dict) or "vulnerabilities" not in answer:
        said = answer.get("message", "") if isinstance(answer, Mapping) else ""
        return [], [f"web pages: npm's registry gave no answer: {said or error}"]
    return [f"{name}: {each['severity']}" for name, each in sorted(answer["vulnerabilities"].items())], []


def _json(command: Sequence[str]) -> tuple[Any, str]:
    """What a program printed as JSON, None if it did not; and the last line of its complaints."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)  # noqa: S603 - tools of .venv
    except (OSError, subprocess.TimeoutExpired) as error:
        return None, str(error)
    complaint = (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]
    try:
        return json.loads(done.stdout), complaint
    except ValueError:
        return None, complaint


if __name__ == "__main__":
    raise SystemExit(main())
