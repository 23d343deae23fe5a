"""Programs that start at once on one database, and programs that are older than it; real processes, both kinds."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_infra.database import Database
from specimap_infra.errors import DatabaseTooNewError
from specimap_infra.migrate import migrate
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.schema_version import ENGINE_SCHEMA, known_revisions, revision_of
from specimap_infra.tables import Project
from tests.support.backup_scene import specimap
from tests.support.databases import sqlalchemy_url

STARTER = """
import logging, sys
from specimap_infra.database import Database
from specimap_infra.migrate import migrate
logging.basicConfig(level=logging.INFO)
print("ready", flush=True)
sys.stdin.readline()
migrate(Database.open(sys.argv[1]))
"""
"""Alembic logs a line for each migration that it runs."""


@pytest.mark.waits
@pytest.mark.slow
def test_programs_that_start_at_once_migrate_once(any_database: str) -> None:
    command = [sys.executable, "-c", STARTER, sqlalchemy_url(any_database)]
    pipe = subprocess.PIPE
    programs = [subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True) for _ in range(4)]
    for program in programs:
        assert program.stdout is not None
        assert program.stdout.readline() == "ready\n"
    for program in programs:
        assert program.stdin is not None
        program.stdin.write("go\n")
        program.stdin.flush()
    logs = [program.communicate(timeout=60)[1] for program in programs]
    assert [program.returncode for program in programs] == [0] * 4, logs
    assert sorted(log.count("Running upgrade") for log in logs) == [0, 0, 0, len(known_revisions())]
    database = Database.open(sqlalchemy_url(any_database))
    with database.session() as session:
        assert revision_of(session.connection()) == known_revisions()[0]
        assert [project.id for project in session.scalars(sa.select(Project))] == [DEFAULT_PROJECT]
    database.close()


@contextmanager
def newer(url: str, part: str) -> Iterator[Database]:
    """A database that a newer release has left; its other part is older than this release."""
    database = Database.open(sqlalchemy_url(url))
    migrate(database)
    engine_versions = (
        "dbos_migrations" if database.engine.dialect.name == "sqlite" else f"{ENGINE_SCHEMA}.dbos_migrations"
    )
    own, engine = ("'9999'", 3) if part == "tables" else ("'0002'", 9999)
    with database.session() as session:
        session.execute(sa.text(f"UPDATE alembic_version SET version_num = {own}"))
        session.execute(sa.text(f"UPDATE {engine_versions} SET version = {engine}"))
    before = state(database, engine_versions)
    yield database
    assert state(database, engine_versions) == before
    database.close()


def state(database: Database, engine_versions: str) -> tuple[object, ...]:
    """Versions, tables with their columns, and how many rows there are."""
    with database.session() as session:
        inspector = sa.inspect(session.connection())
        tables = {table: [c["name"] for c in inspector.get_columns(table)] for table in inspector.get_table_names()}
        rows = {table: session.scalar(sa.text(f"SELECT count(*) FROM {table}")) for table in tables}
        version = session.scalar(sa.text(f"SELECT version FROM {engine_versions}"))
        return revision_of(session.connection()), version, tables, rows


@pytest.mark.parametrize("part", ["tables", "engine"])
def test_an_older_program_refuses_before_it_touches_anything(any_database: str, part: str) -> None:
    with newer(any_database, part) as database, pytest.raises(DatabaseTooNewError, match="newer release"):
        migrate(database)


@pytest.mark.slow
@pytest.mark.parametrize("command", ["serve", "worker", "keys list", "backup --to backup"])
def test_every_program_tells_that_it_is_older(any_database: str, tmp_path: Path, command: str) -> None:
    words = command.replace("backup --to backup", f"backup --to {tmp_path / 'backup'}").split()
    with newer(any_database, "tables"):
        done = specimap({"data_dir": tmp_path / "data", "database_url": any_database, "port": 0}, *words)
    assert done.returncode == 2
    assert "database_too_new" in done.stderr
    assert "Start the newer release" in done.stderr
    assert not (tmp_path / "backup").exists()
