"""A service with data to be saved, and the programs that save and restore it."""

from __future__ import annotations

import os
import subprocess
import sys
import uuid
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest

from specimap_core.errors import NotFoundError
from specimap_infra.database import Database, utc_now
from specimap_infra.ids import new_id
from specimap_infra.references import PLACES
from specimap_infra.settings import ServiceSettings, load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import (
    Artefact,
    Upload,
)
from tests.support.databases import postgres_url
from tests.support.object_store import object_store
from tests.support.service_scene import Running, serving

PROGRAM = "from specimap_cli import main; main()"
AWS = {"AWS_ACCESS_KEY_ID": "test", "AWS_SECRET_ACCESS_KEY": "test"}


@contextmanager
def place(kind: str, folder: Path) -> Iterator[dict[str, Any]]:
    """Settings of an empty ``local`` place (SQLite, a folder), or of a ``shared`` one (PostgreSQL, an S3 store)."""
    settings: dict[str, Any] = {"data_dir": folder, "min_free_bytes": 0}
    with ExitStack() as stack:
        if kind == "shared":
            settings["database_url"] = stack.enter_context(postgres_url())
            # The stores of one process share their buckets.
            bucket = f"specimap-{uuid.uuid4().hex[:12]}"
            settings["s3_endpoint"] = stack.enter_context(object_store(bucket))
            settings["storage"] = f"s3://{bucket}/hospital"
        yield settings


def specimap(given: Mapping[str, object], *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the program with these settings."""
    with started(given, *arguments) as program:
        out, err = program.communicate(timeout=120)
    return subprocess.CompletedProcess(arguments, program.returncode, out, err)


@contextmanager
def started(given: Mapping[str, object], *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """Start the program with these settings; it does not outlive the block."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SPECIMAP_")} | AWS
    environment |= {f"SPECIMAP_{name.upper()}": str(value) for name, value in given.items()}
    command, pipe = [sys.executable, "-W", "error", "-c", PROGRAM, *arguments], subprocess.PIPE
    with subprocess.Popen(command, env=environment, stdout=pipe, stderr=pipe, text=True) as program:
        try:
            yield program
        finally:
            program.kill()


def answers(client: httpx.Client, cloud_id: str) -> dict[str, bytes]:
    """What a client gets of a cloud."""
    found = {
        path: client.get(f"/v1/clouds/{cloud_id}/{path}")
        for path in ("zarr/zarr.json", "points/17", "zarr/labels/tissue/zarr.json")
    }
    assert {answer.status_code for answer in found.values()} == {200}
    return {path: answer.content for path, answer in found.items()}


def stored(storage: Storage) -> dict[str, bytes]:
    """Every stored file by its key."""
    found: dict[str, bytes] = {}
    for name in PLACES:
        with suppress(NotFoundError):
            found |= {item.key: storage.read(item.key) for item in storage.list(name)}
    return found


def add_artefact(database: Database, storage: Storage, acquisition_id: str, stage: str = "render") -> str:
    key = f"acquisitions/{acquisition_id}/stages/{new_id('att')}.npz"
    storage.put(key, b"an artefact")
    with database.session() as session:
        session.add(
            Artefact(
                id=new_id("att"),
                acquisition_id=acquisition_id,
                stage=stage,
                key=new_id("att"),
                storage_key=key,
                size=11,
                seconds=1.0,
            )
        )
    return key


def add_upload(database: Database, acquisition_id: str, state: str) -> str:
    upload_id = new_id("up")
    with database.session() as session:
        session.add(
            Upload(
                id=upload_id,
                acquisition_id=acquisition_id,
                role="photo",
                name="x.jpg",
                size=9,
                state=state,
                expires_at=utc_now(),
                created_by="key_test",
            )
        )
    return upload_id


def fake_capture(folder: Path) -> tuple[Path, Path]:
    """Files that stand in for photos and a cube; the quick stages read neither."""
    photos = folder / "photos"
    photos.mkdir(parents=True)
    for number in range(6):
        (photos / f"{number}.jpg").write_bytes(b"photo %d" % number)
    (folder / "scan.hdr").write_bytes(b"ENVI")
    (folder / "scan.raw").write_bytes(b"\0" * 64)
    return photos, folder / "scan.hdr"


@pytest.fixture
def restored_pair(any_database: str, tmp_path: Path) -> Iterator[tuple[Running, ServiceSettings]]:
    """A service on SQLite, and settings of an empty place on a database of each kind."""
    with serving(tmp_path / "old") as service:
        yield service, load_settings(data_dir=tmp_path / "new", database_url=any_database)
