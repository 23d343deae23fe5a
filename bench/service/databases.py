"""Databases of a PostgreSQL server to measure and to test on, where one answers (PGHOST, PGPORT, PGUSER, ...)."""

from __future__ import annotations

import os
import uuid
from collections.abc import Iterator
from contextlib import contextmanager

import psycopg
from psycopg import sql

NO_POSTGRES = "No PostgreSQL server answers (PGHOST, PGPORT, PGUSER, ...), so there are no figures of one."


def connect(database: str = "") -> psycopg.Connection:
    """A connection to the server, to a database of it or its own."""
    return psycopg.connect(
        host=os.environ.get("PGHOST", "127.0.0.1"),
        dbname=database or os.environ.get("PGDATABASE", "postgres"),
        connect_timeout=3,
        autocommit=True,
    )


def postgres_version() -> str | None:
    """The server's version; None where none answers."""
    try:
        with connect() as server:
            return server.info.parameter_status("server_version")
    except psycopg.OperationalError:
        return None


@contextmanager
def postgres_url() -> Iterator[str]:
    """URL of an empty database of its own, dropped afterwards."""
    with connect() as server, empty_database(server, "specimap_bench_") as url:
        yield url


@contextmanager
def empty_database(server: psycopg.Connection, prefix: str) -> Iterator[str]:
    """URL of an empty database in ``server``, its name with this ``prefix``, dropped afterwards."""
    name = f"{prefix}{uuid.uuid4().hex[:12]}"
    server.execute(sql.SQL("CREATE DATABASE {}").format(sql.Identifier(name)))
    info = server.info
    account = f"{info.user}:{info.password}" if info.password else info.user
    try:
        yield f"postgresql://{account}@{info.host}:{info.port}/{name}"
    finally:
        server.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name)))
