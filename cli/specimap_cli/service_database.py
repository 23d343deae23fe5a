"""The service's database, for the commands of its administrator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from specimap_cli.errors import REFUSED
from specimap_core.errors import SettingsError, SpecimapError

if TYPE_CHECKING:
    from sqlalchemy.orm import Session

    from specimap_infra.database import Database
    from specimap_infra.settings import ServiceSettings

AUDITED_AS = "cli"
"""Stands for the key in the audit trail: access to the database needs no key."""


@contextmanager
def transaction() -> Iterator[Session]:
    """Open a transaction on the database that the settings name; report an error with its advice, and exit with 2."""
    try:
        # Imported late: `specimap --help` and `specimap run` need none of the service's libraries.
        from specimap_infra.database import Database
        from specimap_infra.migrate import migrate
        from specimap_infra.settings import load_settings

        database = Database.open(load_settings().database)
        try:
            # The first key comes before the first start of the service.
            migrate(database)
            with database.session() as session:
                yield session
        finally:
            database.close()
    except ModuleNotFoundError as error:
        typer.echo(f"{error.name} is not installed. Install specimap[service].", err=True)
        raise typer.Exit(REFUSED) from None
    except SpecimapError as error:
        typer.echo(f"{error.code}: {error}", err=True)
        raise typer.Exit(REFUSED) from None


@contextmanager
def existing_database(settings: ServiceSettings) -> Iterator[Database]:
    """Open the database as it is: it is neither made nor brought to this version's schema.

    Raises:
        SettingsError: there is none.
    """
    from specimap_infra.database import Database

    file = Path(settings.database.removeprefix("sqlite:///"))
    if settings.database.startswith("sqlite:///") and not file.is_file():
        raise SettingsError(
            f"There is no database at {file}.",
            advice="Run the command with the settings of the service: SPECIMAP_DATA_DIR or SPECIMAP_DATABASE_URL.",
            setting="data_dir",
        )
    database = Database.open(settings.database)
    try:
        yield database
    finally:
        database.close()
