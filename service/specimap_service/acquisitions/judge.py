"""Judging of arrived files in child processes that reach that file alone: a hostile one costs a copy of a child, and
neither the service nor any other file. What a child says is checked before it is believed."""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import BackendUnavailableError
from specimap_core.json_text import json_text
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_service.acquisitions.verdicts import checked_verdict

CHILDREN = 2
START_SECONDS = 60
LARGEST_ANSWER = 1 << 20
COMMAND = (sys.executable, "-m", "specimap_core.screening")
PASSED_ON = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PYTHONPATH", "HOME", "VIRTUAL_ENV")
"""Environment of a child. It sees no key and no password."""
Verdict = dict[str, Any]
"""As ``specimap_core.screening.verdict.Verdict.as_dict`` gives it."""


class Judge:
    """Up to two children, started when first needed and kept warm. Safe to share between threads."""

    def __init__(
        self, settings: ServiceSettings, environment: Mapping[str, str], command: Sequence[str] = COMMAND
    ) -> None:
        """``environment``: the service's own, of which :data:`PASSED_ON` goes on to the children."""
        self._settings = settings
        self._environment = {name: environment[name] for name in PASSED_ON if name in environment}
        self._command = (
            *command,
            str(settings.judge_memory_bytes),
            str(settings.max_cube_bytes),
            settings.sandbox,
            *map(str, settings.private_places),
        )
        # Threads of its own: a child dies with the thread that started it, and the app's threads come and go.
        self._threads = ThreadPoolExecutor(CHILDREN, thread_name_prefix="judge")
        self._own = threading.local()
        self._children: set[_Child] = set()
        self._lock = threading.Lock()
        self._closed = False

    def photo(
        self, path: Path, dictionary: str, sharpness: Sequence[float], sizes: Sequence[tuple[int, int]]
    ) -> Verdict:
        """Judge a photo, beside the sharpness and sizes of the acquisition's others."""
        task = {"kind": "photo", "path": str(path), "dictionary": dictionary}
        return self._judge({**task, "sharpness": list(sharpness), "sizes": list(sizes)})

    def part(self, path: Path, claimed: str, expected_bytes: int | None) -> Verdict:
        """Tell which part of a cube a file is."""
        return self._judge({"kind": "part", "path": str(path), "claimed": claimed, "expected_bytes": expected_bytes})

    def cube(self, path: Path) -> Verdict:
        """Look into a whole cube, alone in its folder with its data."""
        return self._judge({"kind": "cube", "path": str(path)})

    def warm(self) -> None:
        """Start a child, if none is there, without waiting for it: one will be needed soon."""
        with self._lock:
            needed = not self._children and not self._closed
        if needed:
            self._threads.submit(self._child)

    def close(self) -> None:
        """End the children; a judging under way ends as if its child had crashed."""
        with self._lock:
            self._closed = True
            children = list(self._children)
        for child in children:
            child.kill()
        # A thread that waits for one of them sees it end; pipes are closed only after that.
        self._threads.shutdown(cancel_futures=True)
        for child in children:
            child.close()

    def _judge(self, task: dict[str, Any]) -> Verdict:
        if self._closed:
            raise _stopping()
        try:
            return self._threads.submit(self._ask, task).result()
        except CancelledError as error:
            raise _stopping() from error

    def _ask(self, task: dict[str, Any]) -> Verdict:
        child = self._child()
        scratch = self._settings.scratch / "judging" / f"{uuid.uuid4().hex}.tmp"
        try:
            with disk_errors(scratch):
                scratch.mkdir(parents=True)
            answer = child.ask({**task, "scratch": str(scratch)}, self._settings.judge_seconds)
            try:
                return checked_verdict(task["kind"], answer)
            except ValueError:
                # It ended without an answer, or with one that no reader gives. The child itself is not concerned.
                logger().warning("judging ended without a verdict", kind=task["kind"], too_slow=False)
                return _hostile(task["kind"], slow=False)
        except (TimeoutError, _GoneError) as error:
            self._drop(child)
            if self._closed:
                raise _stopping() from error
            slow = isinstance(error, TimeoutError)
            logger().warning("judging ended without a verdict", kind=task["kind"], too_slow=slow)
            return _hostile(task["kind"], slow=slow)
        finally:
            remove(scratch)

    def _child(self) -> _Child:
        """That of the current thread."""
        child: _Child | None = getattr(self._own, "child", None)
        if child is not None and not child.alive():
            self._drop(child)
            child = None
        return child or self._started()

    def _started(self) -> _Child:
        with self._lock:
            if self._closed:
                raise _stopping()
            child = _Child(self._command, self._environment, self._settings.scratch)
            self._children.add(child)
        try:
            child.receive(START_SECONDS)
        except (TimeoutError, _GoneError) as error:
            self._drop(child)
            raise BackendUnavailableError(
                "Arriving files cannot be judged: the process for it does not start.",
                advice="Install the extra `service` whole; `python -m specimap_core.screening 1 1` says what is wrong.",
            ) from error
        self._own.child = child
        return child

    def _drop(self, child: _Child) -> None:
        self._own.child = None
        child.close()
        with self._lock:
            self._children.discard(child)


def _stopping() -> BackendUnavailableError:
    return BackendUnavailableError("The service is stopping.", advice="Ask again in some seconds.")


def _hostile(kind: str, *, slow: bool) -> Verdict:
    code = "judging_too_slow" if slow else "judging_crashed"
    what = "takes too long to read" if slow else "makes the reader crash"
    facts: Verdict = {"part": "data", "suffix": ".bin"} if kind == "part" else {}
    if kind == "photo":
        facts = {
            "suffix": ".bin",
            "width": None,
            "height": None,
            "sharpness": None,
            "marker_ids": [],
            "dictionary_seen": None,
        }
    reason = f"The {'photo' if kind == 'photo' else 'cube'} {what}: it is damaged, or made to do so."
    advice = "Copy it from the camera again."
    return {"verdict": "refused", "code": code, "reason": reason, "advice": advice, **facts}


class _GoneError(Exception):
    """The child ended."""


class _Child:
    """One process; one thread talks to it."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str], scratch: Path) -> None:
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        self._process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            bufsize=0,
            start_new_session=True,
            env={**environment, **threads, "TMPDIR": str(scratch)},
        )
        self._buffer = b""

    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def ask(self, task: dict[str, Any], seconds: float) -> Verdict:
        """Its answer to a task. Raises TimeoutError, _GoneError."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(json_text(task).encode() + b"\n")
        except (OSError, ValueError) as error:
            raise _GoneError from error
        return self.receive(seconds)

    def receive(self, seconds: float) -> Verdict:
        """Its next line. Raises TimeoutError, _GoneError."""
        assert self._process.stdout is not None
        deadline = time.monotonic() + seconds
        with selectors.DefaultSelector() as selector:
            selector.register(self._process.stdout, selectors.EVENT_READ)
            while b"\n" not in self._buffer:
                if not selector.select(max(0.0, deadline - time.monotonic())):
                    raise TimeoutError
                piece = os.read(self._process.stdout.fileno(), 1 << 16)
                if not piece or len(self._buffer) > LARGEST_ANSWER:
                    raise _GoneError
                self._buffer += piece
        line, _, self._buffer = self._buffer.partition(b"\n")
        try:
            answer: Verdict = json.loads(line)
        except ValueError as error:
            raise _GoneError from error
        return answer

    def kill(self) -> None:
        """End it, and the copy of it that judges a file."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)

    def close(self) -> None:
        """End it, reap it and close its pipes."""
        self.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            with suppress(OSError):
                pipe.close()  # type: ignore[union-attr]
