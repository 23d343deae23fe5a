"""Which objects a key may touch: those of its project; a person those of all its projects; an administrator all; a
share its cloud.

An object of another project is answered exactly like one that does not exist: both are looked for by the same query,
and refused by the same error.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import TypeVar

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import NotFoundError
from specimap_infra.database import Database
from specimap_infra.projects import named, no_project, project_of, within
from specimap_infra.tables import AuditEntry, Base, CloudRow, Project
from specimap_service.auth.keys import Principal
from specimap_service.auth.permissions import AUDIT_ALL
from specimap_service.errors import ForbiddenError, RequestInvalidError

_MOST_KNOWN = 20_000
_ADVICE = {
    "acq": ("acquisition", "GET /v1/acquisitions lists all."),
    "job": ("job", "Check the id; it may have been deleted."),
    "cloud": ("cloud", "GET /v1/clouds lists all."),
    "key": ("key", "GET /v1/keys lists all."),
    "shr": ("share", "GET the shares of the cloud lists all."),
}
Row = TypeVar("Row", bound=Base)


def no_upload() -> NotFoundError:
    """Make the error for an unknown upload; it repeats no text that may be no id."""
    return NotFoundError("There is no such upload.", advice="Create one with POST /v1/uploads.")


def not_found(object_id: str) -> NotFoundError:
    """Make the error for an object that does not exist, or that the key may not see."""
    kind = object_id.partition("_")[0]
    if kind == "prj":
        return no_project(object_id)
    if kind == "up":
        return no_upload()
    noun, advice = _ADVICE[kind]
    return NotFoundError(f"There is no {noun} {object_id}.", advice=advice)


def load(session: Session, principal: Principal, table: type[Row], object_id: str) -> Row:
    """Return the row of an object that the key may touch. Raises NotFoundError."""
    query = sa.select(table).where(table.__table__.c.id == object_id, in_sight(principal, table))
    found: Row | None = session.scalars(query).one_or_none()
    if found is None:
        raise not_found(object_id)
    return found


def in_sight(principal: Principal, table: type[Base], project: str | None = None) -> sa.ColumnElement[bool]:
    """Make the condition on rows of a list: those that the key may touch.

    ``project``: only those of the project of this id or name.
    """
    if principal.cloud_id is not None:
        return table.__table__.c.id == principal.cloud_id if table is CloudRow else sa.false()
    sees_all = principal.is_admin or (table is AuditEntry and principal.may(AUDIT_ALL))
    if project is None:
        return sa.true() if sees_all else within(table, principal.project_ids)
    wanted = sa.select(Project.id).where(named(project))
    return within(table, wanted if sees_all else wanted.where(Project.id.in_(principal.project_ids)))


def project_for_new(session: Session, principal: Principal, wanted: str | None) -> str:
    """Return the id of the project that a new object will have. ``wanted``: its id or name, if the request says one.

    Raises:
        NotFoundError: there is no such project, or it is not among the principal's.
        RequestInvalidError: the request must say one, since the principal has several.
        ForbiddenError: it has none.
    """
    if wanted is not None:
        found = session.scalar(sa.select(Project.id).where(named(wanted), in_sight(principal, Project)))
        if found is None:
            raise no_project(wanted)
        return found
    if not principal.project_ids:
        raise ForbiddenError(
            "Your account belongs to no project.", advice="Ask whoever manages the accounts for the group of one."
        )
    if len(principal.project_ids) > 1:
        raise RequestInvalidError(
            "body.project: needed, since you have several projects.",
            advice="Name one of them; GET /v1/session lists them.",
            fields=[{"where": "body.project", "what": "needed"}],
            projects=list(principal.project_ids),
        )
    return principal.project_ids[0]


class Access:
    """The check of the ids in addresses. Safe to share between threads."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._known: OrderedDict[str, str] = OrderedDict()
        self._lock = threading.Lock()

    def is_known(self, principal: Principal, object_id: str) -> bool:
        """Return whether the key may touch the object, if that is known without a query.

        The object may have been deleted since: whoever loads it finds out.
        """
        if principal.cloud_id is not None:
            return object_id == principal.cloud_id
        # Its project never changes. Whatever another project has is unknown: it takes a query as if it did not exist.
        return principal.is_admin or self._known.get(object_id) in principal.project_ids

    def check(self, principal: Principal, object_id: str) -> None:
        """Raise NotFoundError unless the key may touch the object."""
        with self._database.session() as session:
            project = project_of(session, object_id)
        if project is None or project not in principal.project_ids or principal.cloud_id is not None:
            raise not_found(object_id)
        with self._lock:
            self._known[object_id] = project
            if len(self._known) > _MOST_KNOWN:
                self._known.popitem(last=False)
