"""Which version of the schema a database has, and whether this program knows it."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import sqlalchemy as sa
from alembic.script import ScriptDirectory
from dbos._migration import get_migration_versions, get_sqlite_migration_versions

from specimap_core.errors import SettingsError
from specimap_infra import migrations
from specimap_infra.errors import DatabaseTooNewError

ENGINE_SCHEMA = "dbos"
"""Where the job engine keeps its tables in PostgreSQL; SQLite has one schema for all."""


def engine_schema(dialect: sa.Dialect) -> str | None:
    """Return the schema of the job engine's tables; None where there is one schema for all."""
    return None if dialect.name == "sqlite" else ENGINE_SCHEMA


@cache
def known_revisions() -> tuple[str, ...]:
    """Return the revisions that this program can bring a database to, the newest first."""
    scripts = ScriptDirectory(str(Path(migrations.__file__).parent))
    return tuple(script.revision for script in scripts.walk_revisions())


def revision_of(connection: sa.Connection) -> str | None:
    """Return the revision of a database's own tables; None where it has none."""
    if not sa.inspect(connection).has_table("alembic_version"):
        return None
    return connection.execute(sa.text("SELECT version_num FROM alembic_version")).scalar()


def refuse_newer(engine: sa.Engine) -> None:
    """Refuse a database that a newer release has brought to its schema, before anything in it is changed.

    Raises:
        DatabaseTooNewError: its own tables, or those of the job engine, are newer.
    """
    with engine.connect() as connection:
        revision = revision_of(connection)
    if revision is not None and revision not in known_revisions():
        raise _too_new(f"schema {revision}", f"schema {known_revisions()[0]}", revision)
    # The engine itself would go on with tables that it does not know.
    if engine.dialect.name == "sqlite":
        found, latest = get_sqlite_migration_versions(engine)
    else:
        found, latest = get_migration_versions(engine, ENGINE_SCHEMA, use_listen_notify=True)
    if found > latest:
        raise _too_new(f"version {found} of the job engine's tables", f"version {latest}", str(found))


def refuse_older(engine: sa.Engine) -> None:
    """Refuse a database that has not been brought to this release's schema, for what does not do that itself.

    Raises:
        SettingsError: it holds no tables of Specimap, or older ones.
        DatabaseTooNewError: as of :func:`refuse_newer`.
    """
    refuse_newer(engine)
    with engine.connect() as connection:
        revision = revision_of(connection)
    if revision != known_revisions()[0]:
        raise SettingsError(
            f"The database has {'no tables' if revision is None else f'schema {revision}'} of Specimap; "
            f"this release needs {known_revisions()[0]}.",
            advice="Start the service of this release first, which upgrades the database.",
        )


def _too_new(found: str, known: str, version: str) -> DatabaseTooNewError:
    return DatabaseTooNewError(
        f"The database has {found}, made by a newer release; this one knows up to {known}. Nothing was changed.",
        advice="Start the newer release; or restore the backup made before the upgrade into an empty database.",
        version=version,
    )
