"""Rules of retention: which acquisitions are old enough to go."""

from __future__ import annotations

import datetime

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import Database, utc_now
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import (
    FINAL_STATES,
    Acquisition,
    CloudRow,
    Job,
    LabelVersion,
    LegalHold,
    Project,
    StoredFile,
    Upload,
)

BATCH = 50


def has_rules(settings: ServiceSettings) -> bool:
    """Return whether any acquisition may ever go by a rule."""
    return bool(settings.keep_acquisition_days or any(settings.keep_acquisition_days_of.values()))


def expired(database: Database, settings: ServiceSettings) -> list[str]:
    """Return some acquisitions that rules end now. Raises DatabaseUnavailableError."""
    with database.session() as session:
        found: list[str] = []
        named = _days_of_projects(session, settings)
        for project, days in named.items():
            if days:
                found += session.scalars(_ended(settings, days, Acquisition.project_id == project)).all()
        if settings.keep_acquisition_days:
            others = Acquisition.project_id.not_in(list(named))
            found += session.scalars(_ended(settings, settings.keep_acquisition_days, others)).all()
        return found


def claim(session: Session, acquisition_id: str, settings: ServiceSettings) -> bool:
    """Lock an acquisition, and return whether a rule still ends it: a job or a hold may have come."""
    locked = sa.update(Acquisition).where(Acquisition.id == acquisition_id).values(notes=Acquisition.notes)
    session.execute(locked, execution_options={"synchronize_session": False})
    row = session.get(Acquisition, acquisition_id)
    if row is None:
        return False
    days = _days_of_projects(session, settings).get(row.project_id, settings.keep_acquisition_days)
    return bool(days) and session.scalar(_ended(settings, days, Acquisition.id == acquisition_id)) is not None


def _days_of_projects(session: Session, settings: ServiceSettings) -> dict[str, float]:
    given = settings.keep_acquisition_days_of
    named = sa.or_(Project.id.in_(list(given)), Project.name.in_(list(given)))
    rows = session.execute(sa.select(Project.id, Project.name).where(named)).all()
    return {row.id: given[row.id] if row.id in given else given[row.name] for row in rows}


def _ended(settings: ServiceSettings, days: float, which: sa.ColumnElement[bool]) -> sa.Select[str]:
    before = utc_now() - datetime.timedelta(days=days)
    of_it = Job.acquisition_id == Acquisition.id
    conditions = [
        which,
        Acquisition.created_at < before,
        ~sa.exists().where(
            of_it, sa.or_(Job.state.not_in(FINAL_STATES), Job.created_at >= before, Job.finished_at >= before)
        ),
        ~sa.exists().where(StoredFile.acquisition_id == Acquisition.id, StoredFile.created_at >= before),
        ~sa.exists().where(Upload.acquisition_id == Acquisition.id, Upload.state == "open"),
        ~sa.exists().where(LegalHold.acquisition_id == Acquisition.id),
    ]
    if settings.keep_labelled:
        labelled = sa.select(CloudRow.acquisition_id).join(LabelVersion, LabelVersion.cloud_id == CloudRow.id)
        conditions.append(Acquisition.id.not_in(labelled))
    return sa.select(Acquisition.id).where(*conditions).order_by(Acquisition.id).limit(BATCH)
