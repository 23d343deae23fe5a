"""Changes to exports' rows by workers, each fenced: a row belongs to the executor that claimed it last."""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_infra.database import Database, database_seconds
from specimap_infra.setbacks import Setbacks
from specimap_infra.tables import Export


def claim(database: Database, export_id: str, executor: str) -> Export | None:
    """Claim an export, even if another executor held it; None where it is gone or has ended."""
    open_row = sa.and_(Export.id == export_id, Export.state.in_(["queued", "running"]))
    with database.session() as session:
        session.execute(sa.update(Export).where(open_row).values(state="running", executor=executor))
        return session.scalar(sa.select(Export).where(open_row))


def held(database: Database, export_id: str, executor: str) -> bool:
    """Whether it runs and is this executor's."""
    with database.session() as session:
        return session.scalar(sa.select(Export.id).where(_held(export_id, executor))) is not None


def finish(database: Database, export_id: str, executor: str, values: dict[str, Any]) -> bool:
    """Write the row's end; False where it is not this executor's any more."""
    with database.session() as session:
        done = session.execute(
            sa.update(Export).where(_held(export_id, executor)).values(**values).returning(Export.id)
        )
        return done.first() is not None


def release_export(session: Session, export_id: str, executor: str, *, died: bool) -> Export | None:
    """Leave an export of an executor to others; see :func:`specimap_infra.jobs.release`. None where there is none."""
    export = session.get(Export, export_id, with_for_update=True)
    if export is not None and export.state == "running" and export.executor == executor:
        export.executor = None
        if died:
            now = session.scalars(sa.select(database_seconds(session.get_bind()))).one()
            export.setbacks = Setbacks.of(export.setbacks).interrupted(executor, now).stored()
    return export


def _held(export_id: str, executor: str) -> sa.ColumnElement[bool]:
    return sa.and_(Export.id == export_id, Export.executor == executor, Export.state == "running")
