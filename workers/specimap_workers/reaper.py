"""Looking after jobs whose worker is gone, and after rows and workflows that disagree."""

from __future__ import annotations

import datetime
from collections.abc import Callable

import sqlalchemy as sa
from dbos import DBOSClient

from specimap_core.errors import SpecimapError
from specimap_infra import jobs
from specimap_infra.database import Database, database_errors, utc_now
from specimap_infra.errors import WorkerCrashedError
from specimap_infra.logs import logger
from specimap_infra.notifications import QUEUED, tell
from specimap_infra.queue import queue_client
from specimap_infra.setbacks import Setbacks
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import FINAL_STATES, Export, Job, Lease
from specimap_workers.export_rows import release_export

SETTLED = datetime.timedelta(seconds=30)
"""Age below which a job is not compared with its workflow: the two may just be changing."""
MOST = 200


class Reaper:
    """Used by every worker and their supervisors; two that do the same at once do no harm."""

    def __init__(self, database: Database, client: DBOSClient) -> None:
        self._database = database
        self._client = client

    def look_after(self, living: set[str]) -> None:
        """Hand over the work of executors that are not ``living``. Raises DatabaseUnavailableError, as all here do."""
        with database_errors():
            pending = self._client.list_workflows(status="PENDING", load_input=False, load_output=False)
        for executor in {str(w.executor_id) for w in pending} - living:
            self.hand_over(executor, died=True)

    @database_errors()
    def hand_over(self, executor: str, *, died: bool) -> None:
        """Put what an executor held back in the queue; only its own, and only once, even where others do the same.

        ``died``: it did not stop in order, which is a setback of its work. Work that waits after several setbacks stays
        with the executor until it is looked at again.
        """
        pending = self._client.list_workflows(
            status="PENDING", executor_id=executor, load_input=False, load_output=False
        )
        for workflow in pending:
            with self._database.session() as session:
                job = session.get(Job, workflow.workflow_id)
                cancelled = job is not None and job.state in FINAL_STATES
                if not cancelled:
                    row: Job | Export | None
                    if job is not None:
                        row = jobs.release(session, workflow.workflow_id, executor, died=died)
                    else:
                        row = release_export(session, workflow.workflow_id, executor, died=died)
                    if row is not None and not jobs.may_go_on(session, Setbacks.of(row.setbacks)):
                        continue
            if cancelled:
                # Cancelled while its worker died: it must not come to life again.
                self._client.cancel_workflow(workflow.workflow_id)
                continue
            # The engine's own way for recovery: the row must still be this executor's, and keeps its queue. Resuming
            # instead would reset its attempts and bring a cancelled one back to life.
            queue = str(workflow.queue_name)
            if self._client._sys_db.reenqueue_for_recovery(workflow.workflow_id, [executor], queue):
                logger().warning("work taken over", job=workflow.workflow_id, executor=executor)
                with self._database.session() as session:
                    tell(session, QUEUED, queue)

    def bury(self, executor: str, *, died: bool = True) -> None:
        """Hand over the work of an executor whose process has ended for certain, and remove its lease."""
        with self._database.session() as session:
            session.execute(sa.delete(Lease).where(Lease.executor == executor))
        self.hand_over(executor, died=died)

    @database_errors()
    def settle(self) -> None:
        """Settle what is at odds: jobs and workflows change in two transactions, and a process may die between them."""
        before = utc_now() - SETTLED
        with self._database.session() as session:
            waiting = list(
                session.scalars(
                    sa.select(Job.id)
                    .where(Job.state.not_in(FINAL_STATES), Job.created_at < before)
                    .order_by(Job.created_at)
                    .limit(MOST)
                )
            )
            cancelled = list(
                session.scalars(
                    sa.select(Job.id)
                    .where(Job.state == "cancelled", Job.finished_at > before - datetime.timedelta(hours=1))
                    .limit(MOST)
                )
            )
        known = {}
        if waiting or cancelled:
            found = self._client.list_workflows(workflow_ids=waiting + cancelled, load_input=False, load_output=False)
            known = {w.workflow_id: w.status for w in found}
        for job_id in waiting:
            status = known.get(job_id)
            if status in ("PENDING", "ENQUEUED", "DELAYED"):
                continue
            error: SpecimapError = SpecimapError(
                f"The job's workflow ended as {status or 'missing'} without a result.",
                advice="Rerun the job; report it if it happens again.",
            )
            if status == "MAX_RECOVERY_ATTEMPTS_EXCEEDED":
                error = WorkerCrashedError("The job's worker died again and again.", advice="Look at the job's log.")
            with self._database.session() as session:
                if jobs.fail_orphan(session, job_id, error) is not None:
                    logger().error("job failed: its workflow is gone", job=job_id, status=status)
        for job_id in cancelled:
            if known.get(job_id) in ("PENDING", "ENQUEUED", "DELAYED"):
                self._client.cancel_workflow(job_id)


def burier(settings: ServiceSettings) -> Callable[[str, bool], None]:
    """Make what a supervisor calls with the name of a worker that has ended, and whether it died; it may raise."""
    database = Database.open(settings.database, pool_size=1, overflow=2)
    reaper = Reaper(database, queue_client(database.engine))
    return lambda executor, died: reaper.bury(executor, died=died)
