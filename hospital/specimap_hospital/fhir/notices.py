"""Which results the FHIR server is to be told of. It loads no DICOM library: the API asks for notices, too."""

from __future__ import annotations

import datetime

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_infra.database import Database
from specimap_infra.labels import lock_cloud
from specimap_infra.tables import CloudRow, DicomSet, FhirNotice, Job, SealedStudy

MOST_ADDED = 100


def tell_of(session: Session, cloud_id: str, study_version: int, now: datetime.datetime) -> FhirNotice:
    """Add a result that the server is to be told of, or tell it again."""
    row = session.get(FhirNotice, cloud_id)
    if row is None:
        row = FhirNotice(cloud_id=cloud_id)
        session.add(row)
    row.state, row.attempts, row.next_at, row.study_version = "pending", 0, now, study_version
    row.error, row.sent_at = None, None
    session.flush()
    return row


def add_notices(database: Database, now: datetime.datetime, *, archived: bool) -> int:
    """Add results with a study context of which the server was not told, or with another context.

    ``archived``: only those whose first set of objects the archive has, so that what is told of can be found there.

    Returns: how many. Raises DatabaseUnavailableError.
    """
    wanted = (
        sa.select(CloudRow.id, SealedStudy.version)
        .join(SealedStudy, SealedStudy.acquisition_id == CloudRow.acquisition_id)
        .join(Job, sa.and_(Job.id == CloudRow.job_id, Job.state == "succeeded"))
        .where(~sa.exists().where(FhirNotice.cloud_id == CloudRow.id, FhirNotice.study_version == SealedStudy.version))
        .order_by(CloudRow.id)
        .limit(MOST_ADDED)
    )
    if archived:
        wanted = wanted.where(
            sa.exists().where(
                DicomSet.cloud_id == CloudRow.id,
                DicomSet.first,
                DicomSet.state.in_(("sent", "committed")),
                DicomSet.study_version == SealedStudy.version,
            )
        )
    with database.session() as session:
        found = [(str(cloud_id), int(version)) for cloud_id, version in session.execute(wanted)]
    added = 0
    for cloud_id, version in found:
        with database.session() as session:
            try:
                lock_cloud(session, cloud_id)
            except NotFoundError:
                continue
            row = session.get(FhirNotice, cloud_id)
            # Another process may have added it meanwhile.
            if row is None or row.study_version != version:
                tell_of(session, cloud_id, version, now)
                added += 1
    return added
