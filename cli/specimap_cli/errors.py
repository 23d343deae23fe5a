"""Shared by all commands: exit statuses, errors reported by code and advice, orderly stops."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated

import typer

from specimap_cli.progress import Listener
from specimap_core.errors import (
    BackendUnavailableError,
    CancelledError,
    MemoryExhaustedError,
    SpecimapError,
    StageFailedError,
)

REFUSED = 2
"""Exit status of a refused input."""
FAILED = 1
"""Exit status where the program itself failed: an unforeseen error."""
STOPPED = 130
DEBUG_VARIABLE = "SPECIMAP_DEBUG"
EXTRAS = (
    "Install specimap[pipeline] for runs, reports and validation, specimap[service] for keys and the API, and "
    "specimap[service,workers] for serve and worker."
)
"""The advice where a package is absent: `pip install specimap` alone reads and exports results."""

Debug = Annotated[
    bool, typer.Option("--debug", envvar=DEBUG_VARIABLE, help="Print the traceback of an unforeseen error.")
]


@contextmanager
def stoppable() -> Iterator[Callable[[], bool]]:
    """Let SIGINT and SIGTERM request a stop at the next step; a second one ends the program at once."""
    signals: list[int] = []

    def stop(number: int, _: object) -> None:
        signals.append(number)
        signal.signal(number, signal.SIG_DFL)

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(signals)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _status(error: SpecimapError) -> int:
    if isinstance(error, CancelledError):
        return STOPPED
    return FAILED if isinstance(error, StageFailedError | MemoryExhaustedError) else REFUSED


@contextmanager
def reported_errors(listener: Listener, debug: bool) -> Iterator[None]:
    """Report any error of the block by its code and advice, not by a traceback, and exit accordingly."""
    try:
        yield
    except SpecimapError as error:
        if debug:
            traceback.print_exc()
        listener.refused(error)
        raise typer.Exit(_status(error)) from None
    except BrokenPipeError:
        # The reader of the output has closed it; Python would report that again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise typer.Exit(FAILED) from None
    except ModuleNotFoundError as error:
        if debug:
            traceback.print_exc()
        listener.refused(
            BackendUnavailableError(
                f"This command needs {error.name}, which is not installed.", advice=EXTRAS, module=error.name
            )
        )
        raise typer.Exit(REFUSED) from None
    except Exception as error:
        if debug:
            traceback.print_exc()
        listener.refused(
            SpecimapError(
                f"An error that Specimap does not know: {type(error).__name__}: {error}",
                advice=f"Repeat with {DEBUG_VARIABLE}=1 and report what it prints. Finished stages are kept.",
            )
        )
        raise typer.Exit(FAILED) from None
