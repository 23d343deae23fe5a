"""Telling the FHIR server of results, again after failures, over restarts of this process and of the server."""

from __future__ import annotations

import datetime
from collections.abc import Callable

import sqlalchemy as sa

from specimap_core.errors import CancelledError, SpecimapError, StorageFullError
from specimap_hospital.fhir.client import FhirClient
from specimap_hospital.fhir.elements import Element
from specimap_hospital.fhir.errors import FhirUnavailableError
from specimap_infra.database import Database, utc_now
from specimap_infra.errors import (
    DatabaseUnavailableError,
    StageTimeoutError,
    StorageUnavailableError,
    StudyKeysMissingError,
    WorkerCrashedError,
)
from specimap_infra.logs import logger
from specimap_infra.tables import FhirNotice

CLAIM = datetime.timedelta(seconds=120)
"""How long a notice belongs to the process that sends it; if that one died, it is due again afterwards."""
LONGEST_WAIT = datetime.timedelta(minutes=15)
MOST_AT_ONCE = 20
_PASSING = (
    FhirUnavailableError,
    StageTimeoutError,
    StorageFullError,
    StorageUnavailableError,
    StudyKeysMissingError,
    WorkerCrashedError,
)
"""What another attempt may not meet."""


class FhirSender:
    """Sends what is due. Several at once share the work: a notice belongs to one of them at a time.

    Args:
        bundle_of: makes the transaction of a result by the id of its cloud. Raises SpecimapError where it cannot.
        attempts: after how many the server is told no more, unless somebody asks for it.
    """

    def __init__(
        self, database: Database, client: FhirClient, bundle_of: Callable[[str], Element], *, attempts: int
    ) -> None:
        self._database = database
        self._client = client
        self._bundle_of = bundle_of
        self._attempts = attempts

    def step(self) -> int:
        """Send what is due, at most 20 results; return how many were attempted.

        Raises:
            DatabaseUnavailableError: the database failed; the result under way is due again after two minutes.
        """
        now = utc_now()
        for done in range(MOST_AT_ONCE):
            claimed = self._claim(now)
            if claimed is None:
                return done
            self._send(*claimed)
        return MOST_AT_ONCE

    def _claim(self, now: datetime.datetime) -> tuple[str, int] | None:
        due = sa.and_(FhirNotice.state == "pending", FhirNotice.next_at <= now)
        while True:
            with self._database.session() as session:
                query = sa.select(FhirNotice).where(due).order_by(FhirNotice.next_at).limit(1)
                row = session.scalars(query.with_for_update(skip_locked=True)).first()
                if row is None:
                    return None
                # SQLite locks no row that is read: the first process to change it has it.
                taken = session.execute(
                    sa.update(FhirNotice)
                    .where(FhirNotice.cloud_id == row.cloud_id, FhirNotice.attempts == row.attempts, due)
                    .values(attempts=row.attempts + 1, next_at=utc_now() + CLAIM)
                    .returning(FhirNotice.attempts),
                    execution_options={"synchronize_session": False},
                ).scalar()
                if taken is not None:
                    return row.cloud_id, taken

    def _send(self, cloud_id: str, attempt: int) -> None:
        try:
            self._client.post(self._bundle_of(cloud_id))
        except DatabaseUnavailableError:
            raise
        except CancelledError:
            # This process is to end: the next one goes on at once.
            self._record(cloud_id, attempt, "pending", None, wait=False)
        except SpecimapError as error:
            passes = isinstance(error, _PASSING)
            state = "refused" if not passes else "given_up" if attempt >= self._attempts else "pending"
            self._record(cloud_id, attempt, state, error)
        else:
            self._record(cloud_id, attempt, "sent", None)

    def _record(
        self, cloud_id: str, attempt: int, state: str, error: SpecimapError | None, *, wait: bool = True
    ) -> None:
        pause = min(datetime.timedelta(seconds=2.0 ** min(attempt, 20)), LONGEST_WAIT) if wait else datetime.timedelta()
        with self._database.session() as session:
            session.execute(
                # If another process has sent it meanwhile, its result counts.
                sa.update(FhirNotice)
                .where(FhirNotice.cloud_id == cloud_id, FhirNotice.attempts == attempt, FhirNotice.state == "pending")
                .values(
                    state=state,
                    next_at=utc_now() + pause,
                    error=None if error is None else error.as_dict(),
                    sent_at=utc_now() if state == "sent" else None,
                )
            )
        log = logger().info if error is None else logger().warning
        log("fhir", cloud=cloud_id, attempt=attempt, state=state, code=None if error is None else error.code)
