"""What the claims of a person mean here: roles, and projects."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sqlalchemy as sa
from sqlalchemy.orm import Session

from specimap_core.errors import SpecimapError
from specimap_infra.housekeeping import AUDITED_AS
from specimap_infra.logs import logger
from specimap_infra.projects import named, new_project
from specimap_infra.settings import ServiceSettings
from specimap_infra.tables import Project
from specimap_service.context import audit

MOST_VALUES = 2000
"""Values of a claim that are looked at."""


def found_claim(claims: Mapping[str, Any], path: str) -> Any:
    """Return a claim by its name, or by the names from the outermost in, with dots between; None where there is none.

    A name may have dots of its own, as those that are web addresses have: it is looked for as it is first.
    """
    if path in claims:
        return claims[path]
    found: Any = claims
    for name in path.split("."):
        if not isinstance(found, Mapping) or name not in found:
            return None
        found = found[name]
    return found


def words(value: Any) -> list[str]:
    """Return the words of a claim: of a list, the names of an object, or the one word that it is."""
    if isinstance(value, str):
        return [value]
    if isinstance(value, list | dict):
        return [word for word in list(value)[:MOST_VALUES] if isinstance(word, str)]
    return []


def roles_in(claims: Mapping[str, Any], settings: ServiceSettings) -> tuple[str, ...]:
    """Return the roles that claims give, by the settings alone: a value without an entry gives none."""
    given = words(found_claim(claims, settings.oidc_roles_claim))
    return tuple(sorted({settings.oidc_roles[word] for word in given if word in settings.oidc_roles}))


def projects_in(session: Session, claims: Mapping[str, Any], settings: ServiceSettings) -> tuple[str, ...]:
    """Return the ids of the projects that claims give; makes those that are made when first seen."""
    if not settings.oidc_projects_claim:
        return tuple(filter(None, [_project(session, settings.oidc_project, create=False)]))
    found = set()
    for word in words(found_claim(claims, settings.oidc_projects_claim)):
        if word in settings.oidc_projects:
            found.add(_project(session, settings.oidc_projects[word], create=False))
        elif settings.oidc_create_projects:
            found.add(_project(session, word, create=True))
    return tuple(sorted(project for project in found if project is not None))


def _project(session: Session, wanted: str, *, create: bool) -> str | None:
    found = session.scalar(sa.select(Project.id).where(named(wanted)))
    if found is not None:
        return found
    if create:
        try:
            with session.begin_nested():
                made = new_project(session, wanted).id
                audit(session, AUDITED_AS, "project.create", made)
                return made
        except SpecimapError as error:
            # The group's name is no name of a project, or another request makes the project at this moment.
            logger().warning("group gives no project", code=error.code)
            return session.scalar(sa.select(Project.id).where(named(wanted)))
    logger().warning("a project of SPECIMAP_OIDC_PROJECT or SPECIMAP_OIDC_PROJECTS does not exist")
    return None
