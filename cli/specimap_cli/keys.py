"""``specimap keys``: create, list and revoke keys directly in the database, for the administrator."""

from __future__ import annotations

import datetime
import sys
from enum import StrEnum
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from specimap_cli.service_database import AUDITED_AS, transaction
from specimap_core.errors import NotFoundError, SettingsError
from specimap_core.json_text import json_text

keys_app = typer.Typer(no_args_is_help=True, help="Keys to the API: create, list, revoke.")


class Scope(StrEnum):
    """Scopes of a key; admin includes all."""

    upload = "upload"
    read = "read"
    label = "label"
    intraoperative = "intraoperative"
    audit = "audit"
    admin = "admin"


@keys_app.command()
def create(
    name: Annotated[str, typer.Option(help="Whose key it is; no patient's name.")],
    scope: Annotated[list[Scope], typer.Option(help="What it may do; give it again for more.")],
    project: Annotated[
        str, typer.Option(help="Its project, by name or id; it sees no other, unless it is admin.")
    ] = "",
    expires: Annotated[
        datetime.datetime | None,
        typer.Option(formats=["%Y-%m-%d", "%Y-%m-%dT%H:%M:%S"], help="From when on it is refused, UTC."),
    ] = None,
) -> None:
    """Make a key and print it, alone on standard output. It is shown this once and kept nowhere."""
    with transaction() as session:
        from specimap_infra.database import utc_now
        from specimap_infra.projects import DEFAULT_PROJECT, found_project
        from specimap_service.auth.keys import checked_name, new_key
        from specimap_service.context import audit

        try:
            checked_name(name)
        except ValueError as error:
            told = f"This is no name of a key: {error}."
            raise SettingsError(told, advice="Give another --name.", setting="name") from error
        expires_at = None if expires is None else expires.replace(tzinfo=datetime.UTC)
        if expires_at is not None and expires_at <= utc_now():
            raise SettingsError(
                f"{expires_at.isoformat()} has passed.", advice="Give a later time to --expires.", setting="expires"
            )
        owner = found_project(session, project or DEFAULT_PROJECT)
        row, key = new_key(name, [s.value for s in scope], project_id=owner.id, expires_at=expires_at)
        session.add(row)
        audit(session, AUDITED_AS, "key.create", row.id, scopes=row.scopes)
    told = f"Key {row.id} of the project {owner.name} may: {', '.join(row.scopes)}. It is shown this once."
    typer.echo(told, err=True)
    typer.echo(key)


@keys_app.command(name="list")
def list_keys(as_json: Annotated[bool, typer.Option("--json", help="One JSON line a key.")] = False) -> None:
    """List all keys, revoked ones too, without their secrets."""
    with transaction() as session:
        import sqlalchemy as sa

        from specimap_infra.database import utc_now
        from specimap_infra.tables import ApiKey, Project

        rows, now = list(session.scalars(sa.select(ApiKey).order_by(ApiKey.id))), utc_now()
        projects = {row.id: row.name for row in session.scalars(sa.select(Project))}
    table = Table("id", "name", "project", "scopes", "created", "last used", "state", box=None)
    for row in rows:
        state = "revoked" if row.revoked_at else "expired" if row.expires_at and row.expires_at <= now else "valid"
        if as_json:
            times = {name: getattr(row, name) for name in ("created_at", "last_used_at", "expires_at", "revoked_at")}
            dates = {name: value.isoformat() if value else None for name, value in times.items()}
            named = {"id": row.id, "name": row.name, "project_id": row.project_id, "project": projects[row.project_id]}
            line = {**named, "scopes": row.scopes, "state": state, **dates}
            sys.stdout.write(json_text(line) + "\n")
            continue
        used = row.last_used_at.isoformat(" ", "minutes") if row.last_used_at else "never"
        created = row.created_at.isoformat(" ", "minutes")
        table.add_row(row.id, row.name, projects[row.project_id], " ".join(row.scopes), created, used, state)
    if not as_json:
        # Output to a file or a pipe is not cut at a terminal's width.
        console = Console(markup=False)
        console.print(table) if console.is_terminal else Console(width=300, markup=False).print(table)


@keys_app.command()
def revoke(key_id: Annotated[str, typer.Argument(help="Its id, key_…, as `specimap keys list` shows it.")]) -> None:
    """Revoke a key; it is refused within two seconds everywhere."""
    with transaction() as session:
        from specimap_infra.database import utc_now
        from specimap_infra.tables import ApiKey
        from specimap_service.context import audit

        row = session.get(ApiKey, key_id)
        if row is None:
            raise NotFoundError(f"There is no key {key_id}.", advice="`specimap keys list` lists all.")
        if row.revoked_at is None:
            row.revoked_at = utc_now()
            audit(session, AUDITED_AS, "key.revoke", key_id)
    typer.echo(f"Revoked {key_id}.", err=True)
