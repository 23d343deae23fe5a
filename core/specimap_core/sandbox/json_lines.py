"""Child processes that exchange JSON objects with this one, a line each.

The child may have been taken over by the file that it reads, so its lines are bounded, every wait has a limit, and
its end takes all processes of its group along. :mod:`specimap_core.sandbox.lifetime` is the child's part.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import subprocess
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any, Self

from specimap_core.json_text import json_text

LINE_LIMIT = 1 << 20
"""Bytes of the longest line that is taken from a child."""
TAIL_LINES, TAIL_LINE_LENGTH = 40, 500
TAIL_BYTES = TAIL_LINES * TAIL_LINE_LENGTH
END_SECONDS = 10.0
"""Longest wait for a killed process: one that the kernel cannot end is left."""
SILENT_SECONDS = 2.0
"""How long a process may go on after it has closed its messages: it can answer no more."""
_PIECE_BYTES = 1 << 16
_MOST_PIECES = 32
"""More than a pipe holds: a child that never stops writing does not hold up its parent."""
_END_POLL_SECONDS = 0.05


class ProcessEndedError(Exception):
    """The process has ended: its exit ``status`` (minus the number of a signal), and ``tail`` as of
    :meth:`JsonLineProcess.tail`.
    """

    def __init__(self, status: int, tail: Sequence[str]) -> None:
        super().__init__(f"The process ended {end_text(status)}.")
        self.status = status
        self.tail = list(tail)


class InvalidMessageError(ValueError):
    """The process wrote a line that is no JSON object, or too long. The lines after it can still be received."""


class JsonLineProcess:
    """A child process in a session of its own, with a pipe for each direction and the last lines of its errors.

    One thread at a time sends and receives; :meth:`kill` and :meth:`close` may come from another one. As a context
    manager it is closed at the end.
    """

    def __init__(
        self,
        command: Sequence[str],
        *,
        env: Mapping[str, str],
        cwd: Path | None = None,
        log: Path | None = None,
        takes_messages: bool = True,
    ) -> None:
        """Start ``command`` with the environment ``env`` in the folder ``cwd``.

        ``log``: a file that takes standard output and error, for a program whose libraries print before it can stop
        them. The messages then come on another pipe, whose descriptor is the command's last argument.
        ``takes_messages``: without it, standard input is empty.

        Raises:
            OSError: the program cannot be started.
        """
        self._log = log
        self._lock = threading.Lock()
        self._closed = False
        self._received, self._searched = bytearray(), 0
        self._recent = b""
        self._silent_since = 0.0
        self._messages, childs_end = os.pipe()
        try:
            with open(log, "wb") if log else nullcontext() as output:
                self._process = subprocess.Popen(  # noqa: S603 - commands of Specimap's own
                    [*command, str(childs_end)] if log else list(command),
                    stdin=subprocess.PIPE if takes_messages else subprocess.DEVNULL,
                    stdout=output or childs_end,
                    stderr=output or subprocess.PIPE,
                    pass_fds=(childs_end,) if log else (),
                    bufsize=0,
                    # A group of its own: a kill reaches all that it starts, and the terminal's signals do not reach it.
                    start_new_session=True,
                    cwd=cwd,
                    env=env,
                )
        except BaseException:
            os.close(self._messages)
            raise
        finally:
            os.close(childs_end)
        self._errors = {self._process.stderr.fileno()} if self._process.stderr else set()
        self._open = {self._messages, *self._errors}
        if self._process.stdin:
            os.set_blocking(self._process.stdin.fileno(), False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def pid(self) -> int:
        """Its process id, which is also that of its group."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it has not ended."""
        return self._process.poll() is None

    def send(self, message: Mapping[str, Any], seconds: float) -> None:
        """Send a message. Where the process has ended, nothing happens: :meth:`receive` tells it.

        Raises:
            TimeoutError: the process did not read all of it within ``seconds``.
        """
        assert self._process.stdin is not None
        rest = json_text(message).encode() + b"\n"
        deadline = time.monotonic() + seconds
        with self._lock, suppress(BrokenPipeError):
            while rest and not self._closed:
                pipe = self._process.stdin.fileno()
                left = deadline - time.monotonic()
                # A child that waits for room in the pipe of its errors would never come to read.
                if pipe in self._wait(left, self._open & self._errors, [pipe]):
                    rest = rest[os.write(pipe, rest) :]
                elif left <= 0:
                    raise TimeoutError

    def receive(self, seconds: float) -> dict[str, Any]:
        """Wait for the next message.

        Raises:
            TimeoutError: there was none within ``seconds``.
            InvalidMessageError: the next line is none.
            ProcessEndedError: there are no more; the status is 0 where it has closed its messages and runs on.
        """
        deadline = time.monotonic() + seconds
        with self._lock:
            while (line := self._next_line()) is None:
                left = deadline - time.monotonic()
                if self._messages in self._open:
                    self._wait(left, self._open)
                else:
                    self._wait_for_end(left)
                if left <= 0 and b"\n" not in self._received:
                    # Something that it started, outside its group, may hold the pipe open.
                    if not self.alive and not self._wait(0, self._open & {self._messages}):
                        raise ProcessEndedError(self._process.returncode, self._tail())
                    raise TimeoutError
        return _message(line)

    def tail(self) -> list[str]:
        """The last lines that it wrote on standard error, or in its log; of a progress bar the last state."""
        with self._lock:
            return self._tail()

    def kill(self) -> None:
        """End it and its group, at once, without waiting for that."""
        if not self._closed:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def close(self) -> None:
        """End it and its group, collect its status, and close the pipes; done twice, it is done once."""
        self.kill()
        with self._lock:
            if self._closed:
                return
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(END_SECONDS)
            self._closed = True
            self._take_errors()
            self._open.clear()
            os.close(self._messages)
            for pipe in (self._process.stdin, self._process.stderr):
                if pipe is not None:
                    pipe.close()

    def _wait(self, seconds: float, reading: Collection[int], writing: Collection[int] = ()) -> set[int]:
        """Wait until one of the pipes is ready, and take in what has come; gives those that were ready."""
        with selectors.DefaultSelector() as selector:
            for pipe in reading:
                selector.register(pipe, selectors.EVENT_READ)
            for pipe in writing:
                selector.register(pipe, selectors.EVENT_WRITE)
            ready = {key.fd for key, _ in selector.select(max(seconds, 0.0))}
        for pipe in ready.intersection(reading):
            piece = os.read(pipe, _PIECE_BYTES)
            if not piece:
                self._open.discard(pipe)
                if pipe == self._messages:
                    self._silent_since = time.monotonic()
            elif pipe == self._messages:
                self._received += piece
            else:
                self._recent = (self._recent + piece)[-TAIL_BYTES:]
        return ready

    def _wait_for_end(self, seconds: float) -> None:
        """Wait a moment for the end of a process that sends no more."""
        self._take_errors()
        with suppress(subprocess.TimeoutExpired):
            status = self._process.wait(max(0.0, min(seconds, _END_POLL_SECONDS)))
            raise ProcessEndedError(status, self._tail())
        if time.monotonic() - self._silent_since > SILENT_SECONDS:
            raise ProcessEndedError(0, self._tail())

    def _next_line(self) -> bytes | None:
        end = self._received.find(b"\n", self._searched)
        if end < 0 and len(self._received) <= LINE_LIMIT:
            self._searched = len(self._received)
            return None
        self._searched = 0
        if end < 0:
            self._received.clear()
            raise InvalidMessageError(f"The line is longer than {LINE_LIMIT} bytes.")
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        return line

    def _take_errors(self) -> None:
        for _ in range(_MOST_PIECES):
            if not self._wait(0, self._open & self._errors):
                return

    def _tail(self) -> list[str]:
        if self._log is not None:
            with open(self._log, "rb") as file:
                file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL_BYTES))
                return _last_lines(file.read(TAIL_BYTES))
        self._take_errors()
        return _last_lines(self._recent)


def _last_lines(output: bytes) -> list[str]:
    text = output.decode(errors="replace")
    lines = [line.rstrip().rsplit("\r", 1)[-1][:TAIL_LINE_LENGTH] for line in text.split("\n")]
    return [line for line in lines if line][-TAIL_LINES:]


def end_text(status: int) -> str:
    """How a process ended, by its exit status: "with status 3", or "by SIGSEGV"."""
    return f"by {signal.Signals(-status).name}" if -status in signal.valid_signals() else f"with status {status}"


def _message(line: bytes) -> dict[str, Any]:
    try:
        message = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise InvalidMessageError("The line is no JSON.") from error
    if not isinstance(message, dict):
        raise InvalidMessageError("The line is no JSON object.")
    return message
