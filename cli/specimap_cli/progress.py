"""Progress of a run: bars on a terminal, or one JSON line for each event."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, DownloadColumn, Progress, TaskID, TextColumn, TimeElapsedColumn

from specimap_cli.tables import print_report
from specimap_core.errors import SpecimapError
from specimap_core.json_text import json_text
from specimap_core.report.model import Report

if TYPE_CHECKING:
    from specimap_core.pipeline.outputs import Outputs

STAGE_WORDS = {
    "reconstruct": "1 reconstruct",
    "adjust": "2 bundle-adjust",
    "render": "3 render",
    "register": "4 register",
}


class Listener(Protocol):
    """An object that is notified of a run's progress and end."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
    def progress(self, stage: str, share: float) -> None:
        """A stage has reached this share of its work, 0..1."""
        ...

    def finished(self, report: Report, outputs: Outputs) -> None:
        """The run is finished."""
        ...

    def report(self, report: Report) -> None:
        """A run by another process is finished."""
        ...

    def kept(self, event: str, sentence: str, **facts: object) -> None:
        """A command about the service's data is done: a sentence for a person, facts for a program."""
        ...

    def refused(self, error: SpecimapError) -> None:
        """The run was refused or failed for a stated reason."""
        ...


class _Bars:
    """Bars on standard error, the report on standard output."""

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._progress = Progress(
            TextColumn("{task.description:<16}"),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            console=self._console,
        )
        self._tasks: dict[str, TaskID] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def progress(self, stage: str, share: float) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(STAGE_WORDS.get(stage, stage), total=1.0)
        self._progress.update(self._tasks[stage], completed=share)

    def report(self, report: Report) -> None:
        print_report(report)

    def finished(self, report: Report, outputs: Outputs) -> None:
        print_report(report)
        for name in ("cloud", "mesh", "preview", "report"):
            sys.stdout.write(f"{name:<8} {getattr(outputs, name)}\n")

    def kept(self, event: str, sentence: str, **facts: object) -> None:
        sys.stdout.write(sentence + "\n")

    def refused(self, error: SpecimapError) -> None:
        # Paths may hold square brackets, which rich would take for markup.
        self._console.print(f"[bold red]{error.code}[/]: {escape(error.message)}", highlight=False, soft_wrap=True)
        if error.advice:
            self._console.print(escape(error.advice), highlight=False, soft_wrap=True)


class _Lines:
    """One JSON line per event on standard output."""

    def __init__(self) -> None:
        self._last: tuple[str, int] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def _write(self, **event: object) -> None:
        sys.stdout.write(json_text(event) + "\n")
        sys.stdout.flush()

    def progress(self, stage: str, share: float) -> None:
        step = stage, int(share * 100)
        if step != self._last:
            self._last = step
            self._write(event="progress", stage=stage, share=round(share, 4))

    def report(self, report: Report) -> None:
        self._write(event="finished", report=report.model_dump(mode="json"))

    def finished(self, report: Report, outputs: Outputs) -> None:
        self._write(event="finished", out=str(outputs.folder), report=report.model_dump(mode="json"))

    def kept(self, event: str, sentence: str, **facts: object) -> None:
        self._write(event=event, **facts)

    def refused(self, error: SpecimapError) -> None:
        self._write(event="refused", **error.as_dict())


def progress_listener() -> Listener:
    """Make bars for a person."""
    return _Bars()


def json_listener() -> Listener:
    """Make JSON lines for a program."""
    return _Lines()


class UploadBar:
    """A bar for files being uploaded."""

    def __init__(self) -> None:
        self._progress = Progress(
            TextColumn("{task.description:<16}"),
            BarColumn(),
            DownloadColumn(),
            TimeElapsedColumn(),
            console=Console(stderr=True),
        )
        self._task = self._progress.add_task("upload", total=None)

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def update(self, sent: int, size: int) -> None:
        """``sent`` of ``size`` bytes have arrived."""
        self._progress.update(self._task, completed=sent, total=size)
