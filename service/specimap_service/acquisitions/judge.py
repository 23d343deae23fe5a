"""Judging of arrived files in child processes that reach that file alone: a hostile one costs a copy of a child, and
neither the service nor any other file. A child's answer is checked before it is used."""

from __future__ import annotations

import sys
import threading
import uuid
from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from pathlib import Path
from typing import Any

from specimap_core.atomic import disk_errors, remove
from specimap_core.errors import BackendUnavailableError
from specimap_core.sandbox.json_lines import InvalidMessageError, JsonLineProcess, ProcessEndedError
from specimap_infra.logs import logger
from specimap_infra.settings import ServiceSettings
from specimap_service.acquisitions.verdicts import checked_verdict
from specimap_service.fair_turns import FairTurns, TurnBounds

CHILDREN = TurnBounds(at_once=3, of_key=2, waiting=0, waiting_of_key=0)
"""Files judged at a time, of all keys and of one: however many a key sends, another one finds a child free. How many
wait is bounded before they come here."""
START_SECONDS = 60
COMMAND = (sys.executable, "-m", "specimap_core.screening")
KEPT_VARIABLES = ("PATH", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PYTHONPATH", "HOME", "VIRTUAL_ENV")
"""Variables of the environment that a child gets. They hold no key and no password."""
Verdict = dict[str, Any]
"""As ``specimap_core.screening.verdict.Verdict.as_dict`` gives it."""


class Judge:
    """Up to three children, started when first needed and kept warm, and shared fairly between keys. Safe to share
    between threads.
    """

    def __init__(
        self, settings: ServiceSettings, environment: Mapping[str, str], command: Sequence[str] = COMMAND
    ) -> None:
        """``environment``: the service's own, of which :data:`KEPT_VARIABLES` goes on to the children."""
        self._settings = settings
        self._environment = {name: environment[name] for name in KEPT_VARIABLES if name in environment}
        self._command = (
            *command,
            str(settings.judge_memory_bytes),
            str(settings.max_cube_bytes),
            settings.sandbox,
            *map(str, settings.private_places),
        )
        # Threads of its own: a child dies with the thread that started it, and the app's threads come and go.
        self._threads = ThreadPoolExecutor(CHILDREN.at_once, thread_name_prefix="judge")
        self._turns = FairTurns(CHILDREN)
        self._of_thread = threading.local()
        self._children: set[JsonLineProcess] = set()
        self._lock = threading.Lock()
        self._closed = False

    def photo(
        self, path: Path, dictionary: str, sharpness: Sequence[float], sizes: Sequence[tuple[int, int]], key: str = ""
    ) -> Verdict:
        """Judge a photo, given the sharpness and sizes of the acquisition's others; ``key``: who sent it."""
        task: dict[str, Any] = {"kind": "photo", "path": str(path), "dictionary": dictionary}
        task["most_pixels"] = self._settings.max_photo_pixels
        return self._judge({**task, "sharpness": list(sharpness), "sizes": list(sizes)}, key)

    def part(self, path: Path, claimed: str, expected_bytes: int | None, key: str = "") -> Verdict:
        """Find which part of a cube a file is."""
        task = {"kind": "part", "path": str(path), "claimed": claimed, "expected_bytes": expected_bytes}
        return self._judge(task, key)

    def cube(self, path: Path, key: str = "") -> Verdict:
        """Judge a whole cube, alone in its folder with its data."""
        return self._judge({"kind": "cube", "path": str(path)}, key)

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
        self._turns.close()
        for child in children:
            child.kill()
        # A thread that waits for one of them sees it end; pipes are closed only after that.
        self._threads.shutdown(cancel_futures=True)
        for child in children:
            child.close()

    def _judge(self, task: dict[str, Any], key: str) -> Verdict:
        try:
            with self._turns.turn(key):
                if self._closed:
                    raise _stopping_error()
                return self._threads.submit(self._ask, task).result()
        except CancelledError as error:
            raise _stopping_error() from error

    def _ask(self, task: dict[str, Any]) -> Verdict:
        child = self._child()
        scratch = self._settings.scratch / "judging" / f"{uuid.uuid4().hex}.tmp"
        try:
            with disk_errors(scratch):
                scratch.mkdir(parents=True)
            child.send({**task, "scratch": str(scratch)}, self._settings.judge_seconds)
            answer = child.receive(self._settings.judge_seconds)
            try:
                return checked_verdict(task["kind"], answer)
            except ValueError:
                # The child's copy for this file ended without an answer, or gave one that no reader gives.
                logger().warning("judging ended without a verdict", kind=task["kind"], too_slow=False)
                return _refusal(task["kind"], slow=False)
        except (TimeoutError, InvalidMessageError, ProcessEndedError) as error:
            self._drop(child)
            if self._closed:
                raise _stopping_error() from error
            slow = isinstance(error, TimeoutError)
            logger().warning("judging ended without a verdict", kind=task["kind"], too_slow=slow)
            return _refusal(task["kind"], slow=slow)
        finally:
            remove(scratch)

    def _child(self) -> JsonLineProcess:
        """The child of the current thread."""
        child: JsonLineProcess | None = getattr(self._of_thread, "child", None)
        if child is not None and not child.alive:
            self._drop(child)
            child = None
        return child or self._started()

    def _started(self) -> JsonLineProcess:
        with self._lock:
            if self._closed:
                raise _stopping_error()
            child = JsonLineProcess(self._command, env=self._child_environment())
            self._children.add(child)
        try:
            child.receive(START_SECONDS)
        except (TimeoutError, InvalidMessageError, ProcessEndedError) as error:
            self._drop(child)
            raise BackendUnavailableError(
                "Arriving files cannot be judged: the process for it does not start.",
                advice="Install the extra `service` whole; `python -m specimap_core.screening 1 1` says what is wrong.",
            ) from error
        self._of_thread.child = child
        return child

    def _child_environment(self) -> dict[str, str]:
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
        return {**self._environment, **threads, "TMPDIR": str(self._settings.scratch)}

    def _drop(self, child: JsonLineProcess) -> None:
        self._of_thread.child = None
        child.close()
        with self._lock:
            self._children.discard(child)


def _stopping_error() -> BackendUnavailableError:
    return BackendUnavailableError("The service is stopping.", advice="Ask again in some seconds.")


def _refusal(kind: str, *, slow: bool) -> Verdict:
    code = "judging_too_slow" if slow else "judging_crashed"
    what = "takes too long to read" if slow else "makes the reader crash"
    facts: Verdict = {"part": "data", "suffix": ".bin"} if kind == "part" else {}
    if kind == "photo":
        facts = {
            "suffix": ".bin",
            "width": None,
            "height": None,
            "sharpness": None,
            "clipped": None,
            "marker_ids": [],
            "markers": [],
            "dictionary_seen": None,
        }
    reason = f"The {'photo' if kind == 'photo' else 'cube'} {what}: it is damaged, or made to do so."
    advice = "Copy it from the camera again."
    return {"verdict": "refused", "code": code, "reason": reason, "advice": advice, **facts}
