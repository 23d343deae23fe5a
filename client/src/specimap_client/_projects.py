"""Projects: groups of keys that share their acquisitions and results, and see no others."""

from __future__ import annotations

import builtins

from specimap_client._http import Session, path
from specimap_client._models import Project, id_of


class Projects:
    """``client.projects``. Creating and renaming need the scope ``admin``."""

    def __init__(self, session: Session) -> None:
        self._session = session

    def create(self, name: str) -> Project:
        """A new project; ``client.keys.create`` makes its keys. The name is a pseudonym.

        Raises:
            Conflict: another project has the name.
        """
        return Project.of(self._session.create(path("projects"), {"name": name}))

    def get(self, project: Project | str) -> Project:
        """The project of an id."""
        return Project.of(self._session.json("GET", path("projects", id_of(project))))

    def list(self) -> builtins.list[Project]:
        """The projects that the key sees: its own, for an administrator all."""
        return [Project.of(item) for item in self._session.json("GET", path("projects"))]

    def rename(self, project: Project | str, name: str) -> Project:
        """Give it another name; what belongs to it stays.

        Raises:
            Conflict: another project has the name.
        """
        return Project.of(self._session.json("PATCH", path("projects", id_of(project)), json={"name": name}))
