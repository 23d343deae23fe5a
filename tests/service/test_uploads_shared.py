"""Uploads that several machines serve behind a load balancer: each request may come to another one."""

from __future__ import annotations

import base64
import hashlib
import os
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from specimap_infra.database import Database, utc_now
from specimap_infra.projects import DEFAULT_PROJECT
from specimap_infra.settings import load_settings
from specimap_infra.storage import Storage
from specimap_infra.tables import Upload, UploadPart
from specimap_service.auth.keys import new_key
from specimap_service.errors import UploadLockedError
from specimap_service.uploads.parts import PART, PREFIX, SMALL, UploadParts
from specimap_service.uploads.sweeping import sweep
from tests.support.databases import create_tables, postgres_url
from tests.support.object_store import object_store
from tests.support.round_robin import RoundRobin
from tests.support.service_scene import Running, serving
from tests.support.upload_scene import (
    TUS,
    begun,
    client_at,
    created,
    new_acquisition,
    noise,
    offset_of,
    patch,
    photos,
    process_serving,
    result,
    until_offset,
)

PHOTO = photos()[0].read_bytes()
MORE = 1_500_000
"""Bytes after which what came before has been gathered."""


@dataclass
class Site:
    """A database and a storage, machines with a disk each, and a balancer in front of them."""

    folder: Path
    given: dict[str, Any]
    database: Database
    storage: Storage
    key: str
    stack: ExitStack
    balancer: RoundRobin = field(default_factory=lambda: RoundRobin([]))
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def start(self) -> str:
        """Start a machine; its own address."""
        name = f"machine-{len(self.processes)}"
        process, url = self.stack.enter_context(process_serving(self.folder / name, **self.given))
        self.processes.append(process)
        self.balancer.servers.append(url)
        return url

    def kill(self, number: int) -> None:
        """Kill a machine, disk and all: nothing of it comes back."""
        self.processes[number].kill()
        self.processes[number].wait()

    def client(self, url: str = "") -> httpx.Client:
        """A client of one machine, or of the balancer, with a connection for each request."""
        client = client_at(url or self.balancer.url, self.key, {"Connection": "close"})
        return self.stack.enter_context(client)


@contextmanager
def site(folder: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    """A site whose storage is a bucket, or a folder that all machines see."""
    with ExitStack() as stack:
        url = stack.enter_context(postgres_url())
        given: dict[str, Any] = {"database_url": url, "storage": str(folder / "shared")}
        if kind == "bucket":
            monkeypatch.setenv("AWS_ACCESS_KEY_ID", "test")
            monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "test")
            endpoint = stack.enter_context(object_store("specimap"))
            given |= {"storage": "s3://specimap/site", "s3_endpoint": endpoint}
        settings = load_settings(data_dir=folder / "here", **given)
        database = Database.open(settings.database)
        stack.callback(database.close)
        create_tables(database)
        row, key = new_key("test", ("upload", "read", "admin"), project_id=DEFAULT_PROJECT)
        with database.session() as session:
            session.add(row)
        made = Site(folder, given, database, Storage.open(settings), key, stack)
        stack.callback(made.balancer.close)
        yield made


@pytest.mark.waits
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["bucket", "folder"])
def test_an_upload_goes_on_at_any_machine_and_outlives_them(
    tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = noise(PART * 3 + 1_234_567)
    with site(tmp_path, kind, monkeypatch) as here:
        one, two = here.start(), here.start()
        client = here.client()
        at = created(client, new_acquisition(client), "cube", len(data), "x.raw")
        # Pieces of many sizes, each at another machine than the one before; and both tell the same.
        offset = 0
        for size in (1, 1000, SMALL + 5, 700_000, 3):
            assert patch(client, at, data[offset : offset + size], offset).status_code == 204
            offset += size
            assert [offset_of(here.client(url), at) for url in (one, two)] == [offset, offset]
        assert set(here.balancer.sent) == {one, two}
        assert patch(client, at, b"x", offset - 1).status_code == 409
        wrong = base64.b64encode(hashlib.sha256(b"other").digest()).decode()
        assert (
            patch(client, at, data[offset : offset + 9], offset, **{"Upload-Checksum": f"sha256 {wrong}"}).status_code
            == 460
        )
        assert offset_of(client, at) == offset
        # One is killed in the middle of a request, and the other goes on once the lock has run out.
        connection = begun(one, at, here.key, data, offset, offset + PART + MORE)
        described = until_offset(here.client(two), at, offset + PART)
        here.kill(0)
        connection.close()
        offset = offset_of(client, at)
        assert offset == described
        assert patch(client, at, data[offset : offset + PART + 7], offset).status_code == 204
        # All are killed, and others take their place.
        here.kill(1)
        here.balancer.servers.clear()
        here.start(), here.start()
        offset = offset_of(client, at)
        assert offset == described + PART + 7
        assert patch(client, at, data[offset:-5], offset).status_code == 204
        done = patch(client, at, data[-5:], len(data) - 5)
        assert done.headers["Specimap-Verdict"] == "accepted"
        assert offset_of(client, at) == len(data)
        file = result(client, at)["file"]
        assert file["sha256"] == hashlib.sha256(data).hexdigest()
        # Nothing is left of the parts, on no machine and in no table.
        assert list(here.storage.list(PREFIX)) == []
        assert [p for n in (2, 3) for p in (tmp_path / f"machine-{n}" / "scratch" / "uploads").iterdir()] == []
        with here.database.session() as session:
            assert session.scalars(sa.select(UploadPart)).all() == []


@pytest.mark.slow
def test_one_request_writes_at_a_time_and_a_dead_one_gives_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = noise(PART + 2 * MORE)
    with site(tmp_path, "folder", monkeypatch) as here:
        one, two = here.start(), here.start()
        client = here.client(two)
        at = created(client, new_acquisition(client), "cube", len(data), "x.raw")

        ended, answers = threading.Event(), list[int]()

        def slowly() -> Iterator[bytes]:
            yield data[: PART + MORE]
            for number in range(PART + MORE, len(data)):
                if ended.wait(0.2):
                    return
                yield data[number : number + 1]

        slow = here.client(one)
        first = threading.Thread(target=lambda: answers.append(patch(slow, at, slowly(), 0).status_code))
        first.start()
        offset = until_offset(client, at, PART)
        # Another machine's request is refused while bytes come, however few.
        busy = patch(client, at, data[offset:], offset)
        assert (busy.status_code, busy.json()["code"]) == (423, "upload_locked")
        assert client.delete(at, headers=TUS).status_code == 423
        ended.set()
        first.join(30)
        assert answers == [204]
        offset = offset_of(client, at)
        assert offset > PART + MORE
        # And gets its turn where the network of the first has fallen away without a word.
        connection = begun(one, at, here.key, data, offset, offset + 1000)
        time.sleep(0.5)
        taken = patch(client, at, data[offset:], offset)
        if taken.status_code == 409:  # the dead one's last bytes were stored when it gave way
            offset = offset_of(client, at)
            taken = patch(client, at, data[offset:], offset)
        assert taken.status_code == 204, taken.text
        connection.close()
        assert result(client, at)["file"]["sha256"] == hashlib.sha256(data).hexdigest()


@contextmanager
def shared(folder: Path) -> Iterator[tuple[Running, UploadParts]]:
    """A service on PostgreSQL, and the bytes of its uploads."""
    with postgres_url() as url, serving(folder, database_url=url) as service:
        parts = service.app.state.uploads.files
        assert isinstance(parts, UploadParts)
        yield service, parts


def test_who_has_lost_the_lock_writes_nothing(tmp_path: Path) -> None:
    with shared(tmp_path) as (service, parts):
        client = service.client()
        upload_id = created(client, new_acquisition(client), "photo", 100).rsplit("/", 1)[1]
        frozen = parts.try_lock(upload_id)
        assert frozen is not None
        assert parts.try_lock(upload_id) is None
        # What its machine does not renew runs out.
        with service.database.session() as session:
            session.execute(sa.update(Upload).values(holder="another", held_until=0.0))
        after = parts.try_lock(upload_id)
        assert after is not None
        frozen.write(memoryview(b"old"))
        with pytest.raises(UploadLockedError):
            frozen.sync()
        after.write(memoryview(b"new!"))
        after.sync()
        assert parts.size(upload_id) == 4
        frozen.close()
        after.close()
        (stored,) = service.storage.list(PREFIX)
        assert service.storage.read(stored.key) == b"new!"


def test_tiny_pieces_make_few_parts(tmp_path: Path) -> None:
    with shared(tmp_path) as (service, parts):
        client = service.client()
        at = created(client, new_acquisition(client), "photo", len(PHOTO))
        for offset in range(0, 50, 5):
            assert patch(client, at, PHOTO[offset : offset + 5], offset).status_code == 204
        with service.database.session() as session:
            assert [(p.start, p.size) for p in session.scalars(sa.select(UploadPart))] == [(0, 50)]
        assert len(list(service.storage.list(PREFIX))) == 1
        assert patch(client, at, PHOTO[50:], 50).headers["Specimap-Verdict"] == "accepted"
        assert result(client, at)["file"]["sha256"] == hashlib.sha256(PHOTO).hexdigest()
        assert list(service.storage.list(PREFIX)) == []
        assert parts.size(at.rsplit("/", 1)[1]) is None


def test_what_nobody_counts_is_swept_and_what_arrived_is_not(tmp_path: Path) -> None:
    with shared(tmp_path) as (service, parts):
        client = service.client()
        at = created(client, new_acquisition(client), "photo", len(PHOTO))
        upload_id = at.rsplit("/", 1)[1]
        patch(client, at, PHOTO[:1000], 0)
        (kept,) = service.storage.list(PREFIX)
        # What killed processes leave: a part without its row, a part of an upload that has ended, a file put together.
        service.storage.put(f"{PREFIX}/{upload_id}/0000000001000-dead", b"x")
        service.storage.put(f"{PREFIX}/up_{'0' * 26}/0000000000000-dead", b"x")
        gone = parts.folder / f"up_{'0' * 26}.whole"
        gone.write_bytes(b"x")
        os.utime(gone, (0, 0))
        parts.sweep({upload_id}, 3600.0)
        assert len(list(service.storage.list(PREFIX))) == 3
        assert not gone.exists()
        parts.sweep({upload_id}, -1.0)
        assert [item.key for item in service.storage.list(PREFIX)] == [kept.key]
        # An upload that has expired goes with its parts.
        with service.database.session() as session:
            session.get_one(Upload, upload_id).expires_at = utc_now()
        sweep(service.app.state.uploads)
        assert list(service.storage.list(PREFIX)) == []
        assert client.head(at, headers=TUS).status_code == 410


def test_an_ended_upload_and_a_deleted_acquisition_leave_no_parts(tmp_path: Path) -> None:
    with shared(tmp_path) as (service, _):
        client = service.client()
        acquisition = new_acquisition(client)
        for end in ("upload", "acquisition"):
            at = created(client, acquisition, "photo", len(PHOTO))
            patch(client, at, PHOTO[:1000], 0)
            assert len(list(service.storage.list(PREFIX))) == 1
            address = at if end == "upload" else f"/v1/acquisitions/{acquisition}"
            assert client.delete(address, headers=TUS).status_code == 204
            assert list(service.storage.list(PREFIX)) == []


def test_the_reserve_counts_what_has_to_be_put_together(tmp_path: Path) -> None:
    with shared(tmp_path) as (service, parts):
        client = service.client()
        at = created(client, new_acquisition(client), "photo", len(PHOTO))
        patch(client, at, PHOTO[:1000], 0)
        with service.database.session() as session:
            assert parts.coming(session) == len(PHOTO)
