"""Study contexts in the database, encrypted. Nothing of what they say goes into logs, the audit trail or errors."""

from __future__ import annotations

from dataclasses import dataclass

import sqlalchemy as sa
from pydantic import ValidationError
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_infra.database import Database, rows_changed, utc_now
from specimap_infra.errors import StudyKeysMissingError, StudySealedError
from specimap_infra.settings import ServiceSettings
from specimap_infra.study_context import StudyContext
from specimap_infra.study_keys import KeyMissingError, SealError, StudyKeys
from specimap_infra.tables import Acquisition, CloudRow, DicomSet, FhirNotice, SealedStudy

BATCH = 200


@dataclass(frozen=True)
class Study:
    """A study context that was opened, and the row that keeps it."""

    context: StudyContext
    row: SealedStudy


def study_keys(settings: ServiceSettings) -> StudyKeys:
    """Return the keys. Raises StudyKeysMissingError where none is set."""
    keys = StudyKeys.of_settings(settings)
    if not keys:
        raise StudyKeysMissingError(
            "No key to encrypt patient data with is set, so no study context is kept.",
            advice="Ask whoever runs the service to set SPECIMAP_STUDY_KEYS; docs/pacs.md says how.",
        )
    return keys


def put_study(session: Session, keys: StudyKeys, acquisition_id: str, context: StudyContext, by: str) -> SealedStudy:
    """Keep a study context in the place of what was there. The same one again changes nothing.

    Raises:
        NotFoundError: there is no such acquisition. StudySealedError: what is there does not open.
    """
    _lock(session, acquisition_id)
    row = session.get(SealedStudy, acquisition_id, populate_existing=True)
    if row is not None and opened(keys, row) == context:
        return row
    key_id, sealed = keys.seal(context.model_dump_json().encode(), acquisition_id)
    if row is None:
        row = SealedStudy(acquisition_id=acquisition_id, version=_last_version(session, acquisition_id) + 1)
        session.add(row)
    else:
        row.version += 1
    row.key_id, row.sealed, row.updated_at, row.updated_by = key_id, sealed, utc_now(), by
    session.flush()
    return row


def _last_version(session: Session, acquisition_id: str) -> int:
    """The highest version that something was sent with: one that was removed and entered again is another one."""
    mine = sa.select(CloudRow.id).where(CloudRow.acquisition_id == acquisition_id)
    sent = session.scalar(sa.select(sa.func.max(DicomSet.study_version)).where(DicomSet.cloud_id.in_(mine)))
    told = session.scalar(sa.select(sa.func.max(FhirNotice.study_version)).where(FhirNotice.cloud_id.in_(mine)))
    return max(sent or 0, told or 0)


def find_study(session: Session, keys: StudyKeys, acquisition_id: str) -> Study | None:
    """Return the study context of an acquisition; None where it has none. Raises StudySealedError."""
    row = session.get(SealedStudy, acquisition_id)
    return None if row is None else Study(opened(keys, row), row)


def opened(keys: StudyKeys, row: SealedStudy) -> StudyContext:
    """Decrypt a row. Raises StudySealedError."""
    try:
        return StudyContext.model_validate_json(keys.open(row.key_id, row.sealed, row.acquisition_id))
    except KeyMissingError:
        raise StudySealedError(
            f"The study context of {row.acquisition_id} was encrypted with the key {row.key_id}, which is not set.",
            advice="Put that key back into SPECIMAP_STUDY_KEYS, after the newest one.",
            key_id=row.key_id,
        ) from None
    except (SealError, ValidationError):
        raise StudySealedError(
            f"The study context of {row.acquisition_id} does not open: its row was changed, or belongs elsewhere.",
            advice="Enter it again, and look for who changed the database.",
            key_id=row.key_id,
        ) from None


def rotate(database: Database, keys: StudyKeys) -> tuple[int, int]:
    """Encrypt all study contexts with the newest key, a few at a time, while the service runs.

    Returns: how many it encrypted anew, and how many do not open and were left as they are.
    """
    done, left, after = 0, 0, ""
    while True:
        with database.session() as session:
            query = sa.select(SealedStudy).where(SealedStudy.acquisition_id > after)
            rows = session.scalars(query.order_by(SealedStudy.acquisition_id).limit(BATCH)).all()
            for row in rows:
                after = row.acquisition_id
                if row.key_id == keys.newest:
                    continue
                try:
                    text = keys.open(row.key_id, row.sealed, row.acquisition_id)
                except (KeyMissingError, SealError):
                    left += 1
                    continue
                key_id, sealed = keys.seal(text, row.acquisition_id)
                # Who changes it meanwhile wins, with the newest key.
                changed = session.execute(
                    sa.update(SealedStudy)
                    .where(SealedStudy.acquisition_id == row.acquisition_id, SealedStudy.sealed == row.sealed)
                    .values(key_id=key_id, sealed=sealed),
                    execution_options={"synchronize_session": False},
                )
                done += rows_changed(changed)
        if len(rows) < BATCH:
            return done, left


def _lock(session: Session, acquisition_id: str) -> None:
    """Let changes of one acquisition's study context come one after the other."""
    # A write that changes nothing, since SQLite locks by writes only.
    found = session.execute(
        sa.update(Acquisition)
        .where(Acquisition.id == acquisition_id)
        .values(notes=Acquisition.notes)
        .returning(Acquisition.id),
        execution_options={"synchronize_session": False},
    )
    if found.first() is None:
        raise NotFoundError(f"There is no acquisition {acquisition_id}.", advice="GET /v1/acquisitions lists all.")
