"""Job queue: its names and its client. DBOS keeps durable workflows in the same database as the tables."""

from __future__ import annotations

import sqlalchemy as sa
from dbos import DBOSClient, DBOSPortableJSONSerializer, WorkflowSerializationFormat
from sqlalchemy.orm import Session

from specimap_infra.notifications import QUEUED, tell

JsonSerializer = DBOSPortableJSONSerializer
"""Inputs and outputs are stored as JSON; a pickle in a database is a program."""
JOBS = "specimap-jobs"
EXPORTS = "specimap-exports"
RUN_JOB = "run_job"
"""Workflow with one argument, the job's id, which is also the workflow's."""
MAKE_EXPORT = "make_export"
"""Workflow with one argument, the export's id, which is also the workflow's."""
APPLICATION = "specimap"
APPLICATION_VERSION = "1"
"""Fixed: by default it is a hash of the code, and a new version would never run the jobs of an old one."""
POLL_SECONDS = 0.25
"""How often SQLite, which notifies nobody, is asked for what is new."""
QUIET_SECONDS = 10.0
"""How often PostgreSQL is, in case that a notification was lost."""


def poll_seconds(engine: sa.Engine) -> float:
    """Return how often who waits for something new asks the database."""
    return POLL_SECONDS if engine.dialect.name == "sqlite" else QUIET_SECONDS


def queue_client(engine: sa.Engine) -> DBOSClient:
    """Make a client that enqueues and cancels; it runs nothing."""
    return DBOSClient(
        system_database_engine=engine,
        serializer=JsonSerializer(),
        application_name=APPLICATION,
        retry_connection_errors=False,
        lazy=True,
    )


def enqueue(client: DBOSClient, session: Session, queue: str, workflow: str, id: str, priority: int) -> None:
    """Enqueue within the caller's transaction, so that a row and its workflow exist together or not at all."""
    client.enqueue_in_transaction(
        session.connection(),
        {
            "workflow_name": workflow,
            "queue_name": queue,
            "workflow_id": id,
            "workflow_id_reuse_policy": "reject",
            "app_version": APPLICATION_VERSION,
            # Unset would run before priority 1.
            "priority": priority,
            "serialization_type": WorkflowSerializationFormat.PORTABLE,
        },
        id,
    )
    tell(session, QUEUED, queue)
