"""``specimap projects``: create, list and rename projects directly in the database, for the administrator."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from specimap_cli.service_database import AUDITED_AS, transaction
from specimap_core.json_text import json_text

projects_app = typer.Typer(
    no_args_is_help=True, help="Projects: groups of keys that share their acquisitions and results, and see no others."
)
Name = Annotated[str, typer.Argument(help="Letters, digits, dot, dash, underscore; no patient's name.")]


@projects_app.command()
def create(name: Name) -> None:
    """Create a project and print its id. `specimap keys create --project` makes its keys."""
    with transaction() as session:
        from specimap_infra.projects import new_project
        from specimap_service.context import audit

        project = new_project(session, name)
        audit(session, AUDITED_AS, "project.create", project.id)
    typer.echo(project.id)


@projects_app.command(name="list")
def list_projects(as_json: Annotated[bool, typer.Option("--json", help="One JSON line a project.")] = False) -> None:
    """List all projects."""
    with transaction() as session:
        import sqlalchemy as sa

        from specimap_infra.tables import Project

        rows = list(session.scalars(sa.select(Project).order_by(Project.id)))
    for row in rows:
        line = {"id": row.id, "name": row.name, "created_at": row.created_at.isoformat()}
        sys.stdout.write(json_text(line) + "\n" if as_json else f"{row.id}  {row.name}\n")


@projects_app.command()
def rename(project: Annotated[str, typer.Argument(help="Its name so far, or its id.")], name: Name) -> None:
    """Rename a project; its keys and all that it holds stay."""
    with transaction() as session:
        from specimap_infra.projects import found_project, rename_project
        from specimap_service.context import audit

        row = found_project(session, project)
        rename_project(session, row, name)
        audit(session, AUDITED_AS, "project.rename", row.id)
    typer.echo(f"{row.id} is called {name}.", err=True)
