"""``specimap identity``: check the identity provider's settings; list, block and let in the people who use it."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from specimap_cli.errors import FAILED, Debug, reported_errors
from specimap_cli.progress import json_listener, progress_listener
from specimap_cli.service_database import AUDITED_AS, transaction
from specimap_core.errors import NotFoundError
from specimap_core.json_text import json_text

identity_app = typer.Typer(no_args_is_help=True, help="Sign-in with an identity provider: check it, block people.")
MARKS = {True: "ok     ", False: "WRONG  ", None: "       "}
PersonId = Annotated[str, typer.Argument(help="Its id, person_…, as `specimap identity people` shows it.")]


@identity_app.command()
def check(
    token: Annotated[
        bool, typer.Option("--token", help="Read a token from standard input, and tell what its claims give.")
    ] = False,
    json_events: Annotated[bool, typer.Option("--json", help="One JSON line a finding.")] = False,
    debug: Debug = False,
) -> None:
    """Check the settings against the identity provider. Exits with 1 where something is wrong."""
    with reported_errors(json_listener() if json_events else progress_listener(), debug):
        from specimap_infra.settings import load_settings
        from specimap_service.auth.oidc.checking import check_identity

        # Not as an argument, which other users of the machine could read.
        text = sys.stdin.readline() if token else None
        wrong = False
        for finding in check_identity(load_settings(), text):
            wrong = wrong or finding.fine is False
            if json_events:
                line = {"event": "checked", "what": finding.what, "fine": finding.fine, "told": finding.told}
                sys.stdout.write(json_text(line) + "\n")
            else:
                typer.echo(f"{MARKS[finding.fine]}{finding.what}: {finding.told}")
    if wrong:
        raise typer.Exit(FAILED)


@identity_app.command()
def people(as_json: Annotated[bool, typer.Option("--json", help="One JSON line a person.")] = False) -> None:
    """List the people who have signed in, by their pseudonyms."""
    with transaction() as session:
        import sqlalchemy as sa

        from specimap_infra.tables import Person

        for row in session.scalars(sa.select(Person).order_by(Person.id)):
            used = row.last_used_at and row.last_used_at.isoformat()
            line = {"id": row.id, "issuer": row.issuer, "last_used_at": used, "blocked": row.blocked_at is not None}
            blocked = "  blocked" if row.blocked_at else ""
            typer.echo(json_text(line) if as_json else f"{row.id}  last used {used or 'never'}{blocked}")


@identity_app.command()
def block(person_id: PersonId) -> None:
    """Block a person: sessions end and tokens are refused within two seconds, whatever the provider says."""
    _set_blocked(person_id, blocked=True)


@identity_app.command()
def unblock(person_id: PersonId) -> None:
    """Let a blocked person in again."""
    _set_blocked(person_id, blocked=False)


def _set_blocked(person_id: str, *, blocked: bool) -> None:
    with transaction() as session:
        import sqlalchemy as sa

        from specimap_infra.database import utc_now
        from specimap_infra.tables import Person, SignIn
        from specimap_service.context import audit

        row = session.get(Person, person_id)
        if row is None:
            raise NotFoundError(f"There is no person {person_id}.", advice="`specimap identity people` lists all.")
        if (row.blocked_at is not None) != blocked:
            row.blocked_at = utc_now() if blocked else None
            session.execute(sa.delete(SignIn).where(SignIn.person_id == person_id))
            audit(session, AUDITED_AS, "person.block" if blocked else "person.unblock", person_id)
    typer.echo(f"{'Blocked' if blocked else 'Let in'} {person_id}.", err=True)
