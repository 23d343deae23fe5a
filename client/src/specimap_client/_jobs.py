"""Jobs: submitted, followed, cancelled, run again; their logs and reports."""

from __future__ import annotations

import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

from specimap_client import _retries
from specimap_client._errors import ConnectionFailed, JobFailed, ServerError, Timeout, UnexpectedAnswer
from specimap_client._events import HeldBackError, job_events
from specimap_client._http import Session, path
from specimap_client._models import Acquisition, Event, Job, LogLine, Project, id_of
from specimap_client._report import Report

Priority = Literal["intraoperative", "routine", "research"]
POLL_S = 2.0


class Jobs:
    """``client.jobs``. Where a job is asked for, its id will do."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def submit(
        self,
        acquisition: Acquisition | str,
        *,
        priority: Priority = "routine",
        webhook: Mapping[str, str] | None = None,
        idempotency_key: str | None = None,
        **settings: Any,
    ) -> Job:
        """Queue a job; ``settings`` are method, adjustment, r_pc, r_reg, backend, features and what else the service
        knows.

        Without an ``idempotency_key`` one is made, so that a lost answer does not start the job twice. Give your
        own where your program may crash between submitting and noting the job's id: the same key and request
        return the same job. ``webhook`` is ``{"url": ..., "secret": ...}``.

        Raises:
            Conflict: ``upload_incomplete``, ``details['missing']`` says what; ``idempotency_conflict``.
            Refused: a setting is wrong.
            Forbidden: for the priority ``intraoperative``, the key needs that scope.
        """
        body: dict[str, Any] = {"acquisition_id": id_of(acquisition), "priority": priority}
        if settings:
            body["settings"] = settings
        if webhook is not None:
            body["webhook"] = dict(webhook)
        headers = {"Idempotency-Key": idempotency_key or str(uuid.uuid4())}
        return Job.of(self._session.json("POST", path("jobs"), json=body, headers=headers))

    def get(self, job: Job | str) -> Job:
        """The job as it is now."""
        return Job.of(self._session.json("GET", path("jobs", id_of(job))))

    def list(
        self,
        *,
        acquisition: Acquisition | str | None = None,
        state: str | None = None,
        project: Project | str | None = None,
        **filters: Any,
    ) -> Iterator[Job]:
        """Jobs, newest first, page by page as they are reached. ``project``: as for acquisitions."""
        acquisition_id = None if acquisition is None else id_of(acquisition)
        filters["project"] = None if project is None else id_of(project)
        for item in self._session.pages(path("jobs"), acquisition_id=acquisition_id, state=state, **filters):
            yield Job.of(item)

    def cancel(self, job: Job | str) -> Job:
        """Stop it; finished stages are kept for a rerun. A job that is cancelled already stays so.

        Raises:
            Conflict: it has already ended in another way.
        """
        return Job.of(self._session.json("POST", path("jobs", id_of(job), "cancel"), safe=True))

    def rerun(
        self,
        job: Job | str,
        *,
        priority: Priority | None = None,
        idempotency_key: str | None = None,
        **settings: Any,
    ) -> Job:
        """A new job as this one was, but for ``settings``; stages that these do not touch are not repeated."""
        body: dict[str, Any] = {}
        if priority is not None:
            body["priority"] = priority
        if settings:
            body["settings"] = settings
        headers = {"Idempotency-Key": idempotency_key or str(uuid.uuid4())}
        return Job.of(self._session.json("POST", path("jobs", id_of(job), "rerun"), json=body, headers=headers))

    def delete(self, job: Job | str) -> None:
        """Delete an ended job with its result. Needs the scope ``admin``."""
        self._session.request("DELETE", path("jobs", id_of(job)))

    def events(self, job: Job | str, *, after: int = 0) -> Iterator[Event]:
        """What happens to it, as it happens, until it ends; broken connections are taken up again.

        ``after`` is the ``seq`` of the last event that is known.
        """
        return job_events(self._session, id_of(job), after)

    def log(self, job: Job | str) -> Iterator[LogLine]:
        """Its log, from the first line."""
        for item in self._session.pages(path("jobs", id_of(job), "log")):
            yield LogLine.of(item)

    def report(self, job: Job | str) -> Report:
        """What is said about its result.

        Raises:
            Conflict: it has not succeeded.
        """
        return Report.of(self._session.json("GET", path("jobs", id_of(job), "report")))

    def wait(
        self, job: Job | str, *, progress: Callable[[Job], None] | None = None, timeout: float | None = None
    ) -> Job:
        """Wait until it has succeeded; ``progress`` hears of every change of state, stage and share.

        Follows the stream of events, and asks again and again where something in between holds the stream back.

        Raises:
            JobFailed: it failed or was cancelled.
            Timeout: it has not ended in ``timeout`` seconds; it goes on.
        """
        deadline = None if timeout is None else time.monotonic() + timeout
        told = _Teller(progress)
        current = told(self.get(job))
        try:
            if not current.final:
                for event in job_events(self._session, current.id, deadline=deadline):
                    current = told(_after(current, event))
        except (HeldBackError, UnexpectedAnswer, ConnectionFailed, ServerError):
            pass  # asking again and again tells the same, only later
        while not (current := told(self.get(current))).final:
            left = POLL_S if deadline is None else deadline - time.monotonic()
            if left <= 0:
                raise Timeout(f"{current.id} has not ended in the time given.")
            _retries.sleep(min(POLL_S, left))
        if current.state != "succeeded":
            raise JobFailed(current)
        return current


class _Teller:
    """Tells of a job where it differs from what was told last."""

    def __init__(self, listener: Callable[[Job], None] | None) -> None:
        self._listener = listener
        self._last: tuple[object, ...] = ()

    def __call__(self, job: Job) -> Job:
        now = job.state, job.stage, job.progress
        if now != self._last and self._listener is not None:
            self._listener(job)
        self._last = now
        return job


def _after(job: Job, event: Event) -> Job:
    """The job as far as an event tells."""
    if event.type not in ("state", "progress"):
        return job
    told = {name: event.data[name] for name in ("state", "stage", "progress") if name in event.data}
    return Job.of(job.raw | told)
