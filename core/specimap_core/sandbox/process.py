"""Run a script of ours in a process of its own, under an interpreter that the user may name.

Networks come with libraries that change global state, hold memory and may lack in the program's own interpreter. The
script gets its request in a scratch folder, sends its progress in JSON lines on a pipe, and leaves arrays in the
folder. Whatever happens to either side, neither process nor folder remains.
"""

from __future__ import annotations

import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from specimap_core import errors
from specimap_core.arrays import Array
from specimap_core.atomic import disk_errors
from specimap_core.errors import BackendFailedError, BackendUnavailableError, SpecimapError
from specimap_core.json_text import json_text
from specimap_core.sandbox import child
from specimap_core.sandbox.environment import bare_environment
from specimap_core.sandbox.json_lines import JsonLineProcess, ProcessEndedError, end_text

TICK_SECONDS = 0.2
"""Longest time between two calls of ``progress``, so that a cancellation takes effect while the child computes."""
LAST_LINES = 25
OFFLINE = {
    "HF_HUB_OFFLINE": "1",
    "HF_HUB_DISABLE_TELEMETRY": "1",
    "TRANSFORMERS_OFFLINE": "1",
    "PYTHONUNBUFFERED": "1",
}


@dataclass(frozen=True)
class Answer:
    """What the script returned: arrays by name, facts as JSON values, and the seconds it took."""

    arrays: dict[str, Array]
    facts: dict[str, Any]


def run_child(
    script: Path,
    request: Mapping[str, object],
    arrays: Mapping[str, Array],
    *,
    name: str,
    steps: Mapping[str, float],
    progress: Callable[[float], None],
    python: str | None = None,
    extra_path: Sequence[Path] = (),
    environment: Mapping[str, str] | None = None,
    scratch: Path | None = None,
    keep: Callable[[Path], None] = lambda folder: None,
) -> Answer:
    """Run ``script`` (see :mod:`specimap_core.sandbox.child`) and wait for its answer.

    ``name``: what error messages call it. ``steps``: the steps that it reports, in order, and the share of the
    time that each takes. ``progress`` is called with the whole's share, 0..1, at least every fifth of a second; when
    it raises, all of the child's processes are killed at once. ``python``: the interpreter, by default this one.
    ``extra_path``: folders put first on its module path. ``environment``: additional variables. ``scratch``: where
    the child's folder is made, by default the system's; ``request["folder"]`` names it to the script. ``keep`` is
    called with the folder before it is removed.

    Raises:
        BackendUnavailableError: the interpreter does not start, or lacks a module.
        BackendFailedError: the child crashed or ran out of memory; details hold the last lines it printed.
        SpecimapError: leaves that the script raised, and whatever ``progress`` raised.
    """
    with _folder(name, scratch, keep) as folder:
        with disk_errors(folder):
            given = {
                "script": str(script),
                "extra_path": [str(p) for p in extra_path],
                "request": {**request, "folder": str(folder)},
            }
            (folder / child.REQUEST).write_text(json_text(given), "utf-8")
            np.savez(folder / child.ARRAYS, allow_pickle=False, **arrays)
        facts = _Child(name, folder, python or sys.executable, environment or {}).facts(steps, progress)
        with np.load(folder / child.ANSWER, allow_pickle=False) as stored:
            return Answer(dict(stored), facts)


@contextmanager
def _folder(name: str, scratch: Path | None, keep: Callable[[Path], None]) -> Iterator[Path]:
    target = scratch or Path(tempfile.gettempdir())
    with disk_errors(target):
        target.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=f"specimap-{name}-", dir=target)).resolve()
    try:
        yield folder
        keep(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def child_environment(folder: Path, more: Mapping[str, str]) -> dict[str, str]:
    """The environment without secrets, with settings that keep libraries offline and their temporary files together."""
    return {**bare_environment(), **OFFLINE, "TMPDIR": str(folder), **more}


class _Child:
    """One run of a script."""

    def __init__(self, name: str, folder: Path, python: str, environment: Mapping[str, str]) -> None:
        self._name, self._python = name, python
        try:
            # It ends when its standard input closes, which it does when this process ends in whichever way.
            self._process = JsonLineProcess(
                [python, str(Path(child.__file__).resolve()), str(folder)],
                env=child_environment(folder, environment),
                cwd=folder,
                log=folder / "log.txt",
            )
        except OSError as error:
            raise BackendUnavailableError(
                f"The interpreter of {name}, {python}, does not start: {error.strerror}.",
                advice=f"Name one that does in SPECIMAP_{name.upper()}_PYTHON, or unset it.",
                python=python,
            ) from error

    def facts(self, steps: Mapping[str, float], progress: Callable[[float], None]) -> dict[str, Any]:
        """Wait for the script's facts. The process is gone when this returns or raises."""
        shares, done = _shares(steps), 0.0
        with self._process:
            while True:
                progress(done)
                try:
                    event = self._process.receive(TICK_SECONDS)
                except TimeoutError:
                    continue
                except ProcessEndedError as end:
                    self._raise_ended(end)
                if "error" in event:
                    self._raise_error(event["error"])
                if "done" in event:
                    facts: dict[str, Any] = event["facts"]
                    return facts
                if "step" in event:
                    low, high = shares.get(event["step"], (done, done))
                    done = max(done, low + (high - low) * min(max(event["share"], 0.0), 1.0))

    def _raise_error(self, error: dict[str, Any]) -> NoReturn:
        code, message, details = error["code"], error["message"], dict(error["details"])
        leaf = leaf_of(code)
        if leaf is not None:
            raise leaf(message, advice=error.get("advice", ""), **details)
        details["last_lines"] = self._process.tail()[-LAST_LINES:]
        if code == "import":
            raise BackendUnavailableError(
                f"{self._name} cannot import {details['module'] or 'a module'}: {message}.",
                advice=f"Install it for the interpreter {self._python}, "
                f"or name another in SPECIMAP_{self._name.upper()}_PYTHON; docs/backends.md lists what it needs.",
                **details,
            )
        if code == "memory":
            raise self._out_of_memory(message, details)
        raise BackendFailedError(
            f"{self._name} failed: {message}.", advice="The details hold its last lines; report them.", **details
        )

    def _out_of_memory(self, message: str, details: dict[str, Any]) -> BackendFailedError:
        return BackendFailedError(
            f"{self._name} ran out of memory ({message[:200]}).",
            advice="Give fewer photos or a device with more memory; docs/backends.md says what a run takes.",
            **{**details, "reason": "out_of_memory"},
        )

    def _raise_ended(self, end: ProcessEndedError) -> NoReturn:
        last = end.tail[-LAST_LINES:]
        details = {"status": end.status, "last_lines": last}
        if end.status == -signal.SIGKILL:
            raise self._out_of_memory("the system killed it", details)
        last_line = f" Its last line: {last[-1]}." if last else ""
        raise BackendFailedError(
            f"The process of {self._name} ended {end_text(end.status)}, without an answer.{last_line}",
            advice="The details hold its last lines; `specimap doctor` checks what it needs.",
            **details,
        ) from end


def leaf_of(code: str) -> type[SpecimapError] | None:
    """The leaf of SpecimapError with that code; None where there is none."""
    known = {
        leaf.code: leaf for leaf in vars(errors).values() if isinstance(leaf, type) and issubclass(leaf, SpecimapError)
    }
    return known.get(code)


def _shares(steps: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """From where to where each step takes the whole."""
    total, low, found = sum(steps.values()), 0.0, {}
    for step, weight in steps.items():
        found[step] = (low / total, (low + weight) / total)
        low += weight
    return found
