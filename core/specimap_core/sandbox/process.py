"""Run a script of ours in a process of its own, under an interpreter that the user may name.

Networks come with libraries that change global state, hold memory and may lack in the program's own interpreter. The
script gets its request in a scratch folder, tells its progress in JSON lines on a pipe, and leaves arrays in the
folder. Whatever happens to either side, neither process nor folder remains.
"""

from __future__ import annotations

import json
import os
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from specimap_core import errors
from specimap_core.atomic import disk_errors
from specimap_core.errors import BackendFailedError, BackendUnavailableError, SpecimapError
from specimap_core.geometry.cameras import Array
from specimap_core.json_text import json_text
from specimap_core.sandbox import child
from specimap_core.sandbox.environment import bare_environment

TICK_SECONDS = 0.2
"""Longest silence between two calls of ``progress``, so that a cancellation is heard while the child computes."""
END_SECONDS = 10.0
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

    ``name``: what error messages call it. ``steps``: the steps that it tells of, in order, and the share of the
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
        facts = _Child(name, folder, python or sys.executable, environment or {}).answer(steps, progress)
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
    """The environment without secrets, with libraries told to stay offline and to keep temporary files together."""
    return {**bare_environment(), **OFFLINE, "TMPDIR": str(folder), **more}


class _Child:
    """One running child."""

    def __init__(self, name: str, folder: Path, python: str, environment: Mapping[str, str]) -> None:
        self._name, self._python, self._log = name, python, folder / "log.txt"
        self._from_child, to_parent = os.pipe()
        try:
            with open(self._log, "wb") as log:
                # A group of its own: a kill reaches whatever it starts. Our end of its standard input closes when we
                # end, in whichever way, and it ends by that.
                self._process = subprocess.Popen(
                    [python, str(Path(child.__file__).resolve()), str(folder), str(to_parent)],
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    pass_fds=(to_parent,),
                    start_new_session=True,
                    cwd=folder,
                    env=child_environment(folder, environment),
                )
        except OSError as error:
            os.close(self._from_child)
            raise BackendUnavailableError(
                f"The interpreter of {name}, {python}, does not start: {error.strerror}.",
                advice=f"Name one that does in SPECIMAP_{name.upper()}_PYTHON, or unset it.",
                python=python,
            ) from error
        finally:
            os.close(to_parent)

    def answer(self, steps: Mapping[str, float], progress: Callable[[float], None]) -> dict[str, Any]:
        """Its facts. It is gone when this returns or raises."""
        try:
            for event in self._events(_shares(steps), progress):
                if "error" in event:
                    self._refuse(event["error"])
                if "done" in event:
                    facts: dict[str, Any] = event["facts"]
                    return facts
            self._crashed()
        finally:
            self._end()

    def _events(
        self, shares: Mapping[str, tuple[float, float]], progress: Callable[[float], None]
    ) -> Iterator[dict[str, Any]]:
        """Everything but progress, which is passed on as it comes, and again while the child is silent."""
        done, rest = 0.0, b""
        with selectors.DefaultSelector() as selector:
            selector.register(self._from_child, selectors.EVENT_READ)
            while True:
                progress(done)
                if not selector.select(TICK_SECONDS):
                    continue
                data = os.read(self._from_child, 1 << 16)
                if not data:
                    return
                *lines, rest = (rest + data).split(b"\n")
                for line in lines:
                    event = json.loads(line)
                    if "step" in event:
                        low, high = shares.get(event["step"], (done, done))
                        done = max(done, low + (high - low) * min(max(event["share"], 0.0), 1.0))
                    else:
                        yield event

    def _end(self) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(END_SECONDS)
        os.close(self._from_child)
        assert self._process.stdin is not None
        self._process.stdin.close()

    def _tail(self) -> list[str]:
        """The last lines that it, or a library, printed; of a progress bar the last state."""
        text = self._log.read_bytes()[-20_000:].decode(errors="replace")
        lines = [line.rsplit("\r", 1)[-1].rstrip()[:500] for line in text.split("\n")]
        return [line for line in lines if line][-LAST_LINES:]

    def _refuse(self, told: dict[str, Any]) -> NoReturn:
        code, message, details = told["code"], told["message"], dict(told["details"])
        leaf = leaf_of(code)
        if leaf is not None:
            raise leaf(message, advice=told.get("advice", ""), **details)
        details["last_lines"] = self._tail()
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

    def _crashed(self) -> NoReturn:
        try:
            status = self._process.wait(END_SECONDS)
        except subprocess.TimeoutExpired:
            status = 0
        details = {"status": status, "last_lines": self._tail()}
        if status == -signal.SIGKILL:
            raise self._out_of_memory("the system killed it", details)
        how = f"by {signal.Signals(-status).name}" if -status in signal.valid_signals() else f"with status {status}"
        last = details["last_lines"]
        said = f" Its last line: {last[-1]}." if isinstance(last, list) and last else ""
        raise BackendFailedError(
            f"The process of {self._name} ended {how}, without an answer.{said}",
            advice="The details hold its last lines; `specimap doctor` checks what it needs.",
            **details,
        )


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
