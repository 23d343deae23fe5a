"""``specimap migrate``: the database's schema, apart from a start."""

from __future__ import annotations

import typer

from specimap_cli.errors import Debug, reported_errors
from specimap_cli.progress import progress_listener


def migrate(debug: Debug = False) -> None:
    """Bring the database to this release's schema, as each start of the service does, and start nothing."""
    with reported_errors(progress_listener(), debug):
        from specimap_infra.database import Database
        from specimap_infra.migrate import migrate as bring
        from specimap_infra.schema_version import known_revisions
        from specimap_infra.settings import load_settings

        database = Database.open(load_settings().database)
        try:
            bring(database)
        finally:
            database.close()
        typer.echo(f"The database has schema {known_revisions()[0]}.")
