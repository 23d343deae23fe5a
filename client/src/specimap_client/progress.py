"""Bars on a terminal for uploads, downloads and jobs. Needs the extra ``progress``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from specimap_client._errors import MissingExtra
from specimap_client._models import Job, Progress

try:
    from rich.progress import BarColumn, DownloadColumn, TaskID, TextColumn, TransferSpeedColumn
    from rich.progress import Progress as RichProgress
except ImportError as error:
    raise MissingExtra("rich", "progress") from error


@dataclass
class Bars:
    """Listeners to give as ``progress``."""

    _rich: RichProgress
    _task: TaskID | None = None

    def files(self, progress: Progress) -> None:
        """Of an upload or a download."""
        if self._task is None:
            self._task = self._rich.add_task("", total=progress.total_size)
        self._rich.update(self._task, description=progress.name, completed=progress.total_sent)

    def job(self, job: Job) -> None:
        """Of a job; one bar for the stage that runs."""
        if self._task is None:
            self._task = self._rich.add_task("", total=1.0)
        self._rich.update(self._task, description=job.stage or job.state, completed=job.progress)


@contextmanager
def file_bar() -> Iterator[Bars]:
    """A bar in bytes: ``with file_bar() as bars: client.acquisitions.upload(..., progress=bars.files)``."""
    with RichProgress(
        TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn()
    ) as progress:
        yield Bars(progress)


@contextmanager
def job_bar() -> Iterator[Bars]:
    """A bar for a job: ``with job_bar() as bars: client.jobs.wait(job, progress=bars.job)``."""
    with RichProgress(TextColumn("{task.description}"), BarColumn()) as progress:
        yield Bars(progress)
