"""Projects: groups of keys that share their objects. Created and renamed by an administrator."""

from __future__ import annotations

import datetime
from typing import Annotated

import sqlalchemy as sa
from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field, StringConstraints
from sqlalchemy.orm import Session

from specimap_infra.projects import new_project, rename_project
from specimap_infra.tables import Project as ProjectRow
from specimap_service.auth.access import in_sight, load
from specimap_service.auth.dependencies import Permitted
from specimap_service.auth.object_ids import ProjectId
from specimap_service.context import Context, audit
from specimap_service.idempotency import IdempotencyKey, Repeatable, repeated
from specimap_service.paging import After, MaybeLimit, Sort, listed, paged

router = APIRouter(prefix="/v1", tags=["projects"])


class ProjectRequest(BaseModel):
    """The name of a project."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"name": "study-7"}})

    name: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9._-]{1,64}$")] = Field(
        description="Letters, digits, dot, dash, underscore; no patient's name. It does not begin with `prj_`."
    )


class Project(BaseModel):
    """A group of keys that share their objects."""

    model_config = ConfigDict(from_attributes=True)

    id: str
    name: str
    created_at: datetime.datetime


@router.post("/projects", status_code=201, responses=repeated(Project), operation_id="projects.create")
def create_project(
    context: Context,
    principal: Permitted,
    response: Response,
    wanted: ProjectRequest,
    idempotency_key: IdempotencyKey = None,
) -> Project:
    """Create a project; then create its keys."""

    def make(session: Session, _: str) -> tuple[str, Project]:
        row = new_project(session, wanted.name)
        audit(session, principal.key_id, "project.create", row.id)
        return row.id, Project.model_validate(row)

    def again(session: Session, project_id: str, _: str) -> Project:
        return Project.model_validate(load(session, principal, ProjectRow, project_id))

    request = Repeatable.of(principal, idempotency_key, "projects.create", wanted.model_dump(mode="json"))
    project, new = request.once(context.database, make, again)
    response.status_code = 201 if new else 200
    return project


@router.get("/projects", operation_id="projects.list")
def list_projects(
    context: Context,
    principal: Permitted,
    request: Request,
    response: Response,
    after: After = None,
    limit: MaybeLimit = None,
    sort: Sort = "created_at",
) -> list[Project]:
    """List the projects that the key sees: its own, for an administrator all."""
    query = paged(sa.select(ProjectRow).where(in_sight(principal, ProjectRow)), ProjectRow.id, after, limit, sort)
    with context.database.session() as session:
        projects = [Project.model_validate(row) for row in session.scalars(query)]
    return listed(request, response, projects, [project.id for project in projects], limit)


@router.get("/projects/{project_id}", operation_id="projects.get")
def get_project(context: Context, principal: Permitted, project_id: ProjectId) -> Project:
    """Return one project."""
    with context.database.session() as session:
        return Project.model_validate(load(session, principal, ProjectRow, project_id))


@router.patch("/projects/{project_id}", operation_id="projects.update")
def change_project(context: Context, principal: Permitted, project_id: ProjectId, wanted: ProjectRequest) -> Project:
    """Rename a project. Its id, its keys and its objects stay as they are."""
    with context.database.session() as session:
        row = load(session, principal, ProjectRow, project_id)
        rename_project(session, row, wanted.name)
        audit(session, principal.key_id, "project.rename", row.id)
    return Project.model_validate(row)
