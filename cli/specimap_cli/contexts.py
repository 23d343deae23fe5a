"""``specimap contexts``: the keys that study contexts are encrypted with."""

from __future__ import annotations

import typer

from specimap_cli.errors import FAILED, Debug, reported_errors
from specimap_cli.progress import progress_listener
from specimap_cli.service_database import existing_database

contexts_app = typer.Typer(no_args_is_help=True, help="The encryption of study contexts, which hold patient data.")


@contexts_app.command("new-key")
def new_key() -> None:
    """Print a new key, to be put first in SPECIMAP_STUDY_KEYS. It is kept nowhere: without it nothing can be read."""
    from specimap_infra.study_keys import new_key as made

    typer.echo(made())


@contexts_app.command()
def rotate(debug: Debug = False) -> None:
    """Encrypt all study contexts with the newest key; then the older ones can be removed. The service may run."""
    with reported_errors(progress_listener(), debug):
        from specimap_infra.schema_version import refuse_older
        from specimap_infra.settings import load_settings
        from specimap_infra.studies import rotate as rotated
        from specimap_infra.studies import study_keys

        settings = load_settings()
        keys = study_keys(settings)
        with existing_database(settings) as database:
            refuse_older(database.engine)
            done, left = rotated(database, keys)
    typer.echo(f"{done} encrypted with the key {keys.newest}.")
    if left:
        typer.echo(f"{left} do not open with the keys that are set, and are left as they are.", err=True)
        raise typer.Exit(FAILED)
