"""Projects: to which one each object belongs.

A key and an acquisition name their project. Everything else belongs to the project of its acquisition, whoever made it,
so that an acquisition and its results are never divided; jobs and clouds hold a copy of its name, for lists.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sa
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, aliased

from specimap_core.errors import NotFoundError, SettingsError
from specimap_infra.database import utc_now
from specimap_infra.errors import JobConflictError
from specimap_infra.ids import new_id
from specimap_infra.tables import (
    Acquisition,
    ApiKey,
    AuditEntry,
    Base,
    CloudRow,
    Export,
    Job,
    Person,
    Project,
    Share,
    StoredFile,
    Upload,
)

DEFAULT_PROJECT = "prj_00000000000000000000000000"
"""The project of everything from before there were projects, and of the first key."""
PROJECT_NAME = r"^(?!prj_)[A-Za-z0-9._-]{1,64}$"
"""A pseudonym, like a specimen's; never to be mistaken for an id."""

_OWNERS: dict[str, sa.Select[str]] = {
    "prj": sa.select(Project.id),
    # A person is of no project.
    "person": sa.select(sa.literal("")).select_from(Person),
    "key": sa.select(ApiKey.project_id),
    "acq": sa.select(Acquisition.project_id),
    **{
        kind: sa.select(Acquisition.project_id)
        .select_from(table)
        .join(Acquisition, Acquisition.id == table.acquisition_id)
        for kind, table in (("file", StoredFile), ("up", Upload), ("job", Job), ("cloud", CloudRow))
    },
    **{
        kind: sa.select(Acquisition.project_id)
        .select_from(table)
        .join(CloudRow, CloudRow.id == table.cloud_id)
        .join(Acquisition, Acquisition.id == CloudRow.acquisition_id)
        for kind, table in (("exp", Export), ("shr", Share))
    },
}
_IDS = {
    "prj": Project.id,
    "person": Person.id,
    "key": ApiKey.id,
    "acq": Acquisition.id,
    "file": StoredFile.id,
    "up": Upload.id,
    "job": Job.id,
    "cloud": CloudRow.id,
    "exp": Export.id,
    "shr": Share.id,
}


def project_of(session: Session, object_id: str) -> str | None:
    """Return the project of the object with an id of any kind; None where there is no such object."""
    kind = object_id.partition("_")[0]
    if kind not in _OWNERS:
        return None
    return session.scalar(_OWNERS[kind].where(_IDS[kind] == object_id))


def acquisition_of(session: Session, object_id: str) -> str | None:
    """Return the acquisition that an object belongs to; None where it belongs to none, or is not there."""
    kind = object_id.partition("_")[0]
    if kind in ("prj", "key", "person") or kind not in _OWNERS:
        return None
    return session.scalar(_OWNERS[kind].with_only_columns(Acquisition.id).where(_IDS[kind] == object_id))


def within(table: type[Base], projects: sa.Select[str] | Sequence[str]) -> sa.ColumnElement[bool]:
    """Make the condition that rows of a table belong to one of some projects, given by ids, or a query for one id."""
    if isinstance(projects, Sequence) and not projects:
        return sa.false()
    several = isinstance(projects, Sequence) and len(projects) > 1
    one = projects[0] if isinstance(projects, Sequence) else projects.scalar_subquery()

    def is_one(column: Any) -> sa.ColumnElement[bool]:
        # Not always `in`, with which SQLite would sort all that a large project has for each page.
        found: sa.ColumnElement[bool] = column.in_(projects) if several else column == one
        return found

    if table is Project:
        return is_one(Project.id)
    columns: Any = table
    if table in (Acquisition, ApiKey, AuditEntry, Job, CloudRow):
        return is_one(columns.project_id)
    # An alias, since the query may have acquisitions too.
    owner = aliased(Acquisition)
    return sa.exists().where(owner.id == columns.acquisition_id, is_one(owner.project_id))


def named(wanted: str) -> sa.ColumnElement[bool]:
    """Make the condition that a project has this id or this name."""
    return sa.or_(Project.id == wanted, Project.name == wanted)


def found_project(session: Session, wanted: str) -> Project:
    """Return a project by its id or its name. Raises NotFoundError."""
    found = session.scalar(sa.select(Project).where(named(wanted)))
    if found is None:
        raise no_project(wanted)
    return found


def no_project(wanted: str) -> NotFoundError:
    """Make the error for an unknown project."""
    return NotFoundError(
        f"There is no project {wanted}.", advice="GET /v1/projects or `specimap projects list` shows what there is."
    )


def new_project(session: Session, name: str) -> Project:
    """Create a project. Raises as :func:`rename_project` does."""
    project = Project(id=new_id("prj"), name=name, created_at=utc_now())
    session.add(project)
    rename_project(session, project, name)
    return project


def rename_project(session: Session, project: Project, name: str) -> None:
    """Give a project a name. An error ends the caller's transaction.

    Raises:
        SettingsError: the name is not a pseudonym.
        JobConflictError: another project has it.
    """
    if not re.fullmatch(PROJECT_NAME, name):
        raise SettingsError(
            "A project's name has 1 to 64 letters, digits, dots, dashes and underscores, and does not begin with prj_.",
            advice="Give another name; no patient's.",
            setting="name",
        )
    project.name = name
    try:
        session.flush()
    except IntegrityError as error:
        raise JobConflictError(f"Another project is called {name}.", advice="Give another name.") from error
