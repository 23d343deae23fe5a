"""The database's files belong to the user of the service, also in a folder that others may read."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
import sqlalchemy as sa

from specimap_infra.database import Database
from specimap_infra.migrate import migrate


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    made = tmp_path / "data"
    made.mkdir(mode=0o755)
    before = os.umask(0o022)
    yield made
    os.umask(before)


def modes(folder: Path) -> dict[str, int]:
    return {path.name: stat.S_IMODE(path.stat().st_mode) for path in folder.iterdir()}


def test_new_files_are_private(folder: Path) -> None:
    database = Database.open(f"sqlite:///{folder / 'specimap.db'}")
    try:
        migrate(database)
        with database.session() as session:
            session.execute(sa.text("CREATE TABLE x (y)"))
            found = modes(folder)
    finally:
        database.close()
    assert {"specimap.db", "specimap.db-wal", "specimap.db-shm", "specimap.lock"} <= set(found)
    assert set(found.values()) == {0o600}


@pytest.mark.parametrize(("before", "after"), [(0o644, 0o600), (0o660, 0o660), (0o666, 0o660)])
def test_files_of_an_earlier_version_become_private(folder: Path, before: int, after: int) -> None:
    names = ("specimap.db", "specimap.db-wal", "specimap.db-shm")
    for name in names:
        (folder / name).touch()
        (folder / name).chmod(before)
    Database.open(f"sqlite:///{folder / 'specimap.db'}").close()
    assert modes(folder) == dict.fromkeys(names, after)
