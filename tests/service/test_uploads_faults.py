"""Uploads when things fail: broken connections, killed processes, full disks, two clients at once."""

from __future__ import annotations

import base64
import errno
import hashlib
import os
import threading
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from specimap_infra.database import utc_now
from specimap_infra.tables import Upload
from specimap_service.auth.keys import Principal
from specimap_service.uploads import tus_store
from specimap_service.uploads.lifecycle import Uploads
from specimap_service.uploads.sweeping import sweep
from tests.support.service_scene import Running
from tests.support.upload_scene import (
    TUS,
    BreakingProxy,
    begun,
    client_at,
    created,
    key_in,
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


def test_a_connection_that_breaks_ten_times(service: Running) -> None:
    data = noise(30_000_000)
    client = service.client()
    acquisition = new_acquisition(client)
    proxy = BreakingProxy(service.url, breaks=10, most_bytes=4_000_000, seed=1)
    at = created(client, acquisition, "cube", len(data), "x.raw")
    attempts = 0
    try:
        with client_at(proxy.url, client.headers["Authorization"].removeprefix("Bearer ")) as shaky:
            while True:
                offset = offset_of(client, at)
                attempts += 1
                try:
                    answer = patch(shaky, at, data[offset:], offset)
                except httpx.TransportError:
                    continue
                if answer.status_code == 204:
                    break
                assert answer.status_code in (409, 423), answer.text
    finally:
        proxy.close()
    assert proxy.cut == 10
    assert attempts > 10
    file = result(client, at)["file"]
    assert file["sha256"] == hashlib.sha256(data).hexdigest()
    with client.stream("GET", f"/v1/acquisitions/{acquisition}/files/{file['id']}/content") as back:
        assert b"".join(back.iter_bytes()) == data


@pytest.mark.slow
def test_a_process_killed_in_the_middle_of_a_chunk(tmp_path: Path) -> None:
    data = noise(20_000_000)
    key = key_in(tmp_path)
    with process_serving(tmp_path) as (process, url), client_at(url, key) as client:
        at = created(client, new_acquisition(client), "cube", len(data), "x.raw")
        connection = begun(url, at, key, data, 0, 13_000_000)
        described = until_offset(client, at, 8_000_000)
        process.kill()
        process.wait()
        connection.close()
    with process_serving(tmp_path) as (process, url), client_at(url, key) as client:
        offset = offset_of(client, at)
        assert described <= offset <= 13_000_000
        assert patch(client, at, data[offset:], offset).headers["Specimap-Verdict"] == "accepted"
        assert result(client, at)["file"]["sha256"] == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("ask", ["head", "patch", "result", "sweep"])
def test_a_process_that_died_after_the_last_byte(service: Running, ask: str) -> None:
    client = service.client()
    acquisition = new_acquisition(client)
    at = created(client, acquisition, "photo", len(PHOTO))
    upload_id = at.rsplit("/", 1)[1]
    (service.settings.scratch / "uploads" / upload_id).write_bytes(PHOTO)
    # What a process leaves that died between storing the file and the commit.
    service.storage.put(f"acquisitions/{acquisition}/file_{upload_id.removeprefix('up_')}", PHOTO)
    if ask == "head":
        assert client.head(at, headers=TUS).headers["Specimap-Verdict"] == "accepted"
    elif ask == "patch":
        assert patch(client, at, b"", len(PHOTO)).headers["Specimap-Verdict"] == "accepted"
    elif ask == "sweep":
        with service.database.session() as session:
            session.get_one(Upload, upload_id).expires_at = utc_now()
        sweep(service.app.state.uploads)
    described = result(client, at)
    assert (described["state"], described["file"]["sha256"]) == ("finished", hashlib.sha256(PHOTO).hexdigest())
    (file,) = client.get(f"/v1/acquisitions/{acquisition}/files").json()
    assert file["id"] == described["file"]["id"]
    assert len(list(service.storage.list(f"acquisitions/{acquisition}"))) == 1
    assert list((service.settings.scratch / "uploads").iterdir()) == []


@pytest.mark.slow
def test_a_storage_that_fails_at_the_end_keeps_the_bytes(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    client = service.client()
    at = created(client, new_acquisition(client), "photo", len(PHOTO))

    def broken(key: str, source: Path) -> None:
        raise OSError(errno.EIO, "broken")

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", broken)
        patched.setattr("shutil.copyfile", broken)
        assert patch(client, at, PHOTO, 0).status_code == 503
        assert client.head(at, headers=TUS).status_code == 503
    assert result(client, at)["state"] == "finished"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "status", "code"), [(errno.ENOSPC, 507, "storage_full"), (errno.EIO, 503, "storage_unavailable")]
)
def test_writes_that_fail_are_told(
    service: Running, monkeypatch: pytest.MonkeyPatch, number: int, status: int, code: str
) -> None:
    data = noise(3_000_000)
    client = service.client()
    at = created(client, new_acquisition(client), "cube", len(data), "x.raw")
    write, left = os.write, [1_300_000]

    def failing(handle: int, piece: bytes) -> int:
        if len(piece) < 1000:  # not the upload's
            return write(handle, piece)
        if not left[0]:
            raise OSError(number, os.strerror(number))
        done = write(handle, piece[: left[0]])
        left[0] -= done
        return done

    with monkeypatch.context() as patched:
        patched.setattr(os, "write", failing)
        failed = patch(client, at, data[:1_900_000], 0)
    assert (failed.status_code, failed.json()["code"]) == (status, code)
    assert offset_of(client, at) == 1_300_000
    assert patch(client, at, data[1_300_000:], 1_300_000).status_code == 204
    assert result(client, at)["file"]["sha256"] == hashlib.sha256(data).hexdigest()


def test_two_clients_at_once(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tus_store, "LOCK_SECONDS", 0.5)
    client, second = service.client(), service.client()
    data = noise(6_000_000)
    at = created(client, new_acquisition(client), "cube", len(data), "x.raw")
    go_on = threading.Event()
    answers: list[int] = []

    def alive() -> Iterator[bytes]:
        yield data[:2_000_000]
        at_byte = 2_000_000
        while not go_on.wait(0.05):
            yield data[at_byte : at_byte + 1000]
            at_byte += 1000
        yield data[at_byte:]

    first = threading.Thread(target=lambda: answers.append(patch(client, at, alive(), 0).status_code))
    first.start()
    offset = until_offset(second, at, 1_000_000)
    busy = patch(second, at, data[offset:], offset)
    assert busy.status_code == 423
    assert busy.json()["code"] == "upload_locked"
    assert second.delete(at, headers=TUS).status_code == 423
    go_on.set()
    first.join(timeout=30)
    assert answers == [204]
    assert result(client, at)["file"]["sha256"] == hashlib.sha256(data).hexdigest()


@pytest.mark.parametrize("ask", ["HEAD", "PATCH", "PATCH nothing", "PATCH checked", "DELETE", "result"])
def test_another_request_finishes_the_upload_meanwhile(
    service: Running, monkeypatch: pytest.MonkeyPatch, ask: str
) -> None:
    """Between the look at its row and the lock of its file."""
    client, first = service.client(), service.client()
    at = created(client, new_acquisition(client), "photo", len(PHOTO))
    look = Uploads._current

    def overtaken(self: Uploads, upload_id: str, principal: Principal) -> tuple[Upload, bool]:
        found = look(self, upload_id, principal)
        monkeypatch.setattr(Uploads, "_current", look)
        assert patch(first, at, PHOTO, 0).status_code == 204
        return found

    monkeypatch.setattr(Uploads, "_current", overtaken)
    if ask == "HEAD":
        assert offset_of(client, at) == len(PHOTO)
    elif ask == "DELETE":
        assert client.delete(at, headers=TUS).json()["code"] == "state_conflict"
    elif ask == "result":
        assert (result(client, at)["state"], result(client, at)["offset"]) == ("finished", len(PHOTO))
    elif ask == "PATCH nothing":
        # What a client sends that did not hear the answer to its last byte.
        answer = patch(client, at, b"", len(PHOTO))
        assert answer.status_code == 204
        assert answer.headers["specimap-verdict"] == "accepted"
    else:
        digest = base64.b64encode(hashlib.sha256(PHOTO).digest()).decode()
        checked = {"Upload-Checksum": f"sha256 {digest}"} if ask == "PATCH checked" else {}
        answer = patch(client, at, PHOTO, 0, **checked)
        assert (answer.status_code, answer.json()["code"]) == (409, "upload_conflict")
        assert "HEAD" in answer.json()["advice"]
    assert offset_of(client, at) == len(PHOTO)
    assert result(client, at)["state"] == "finished"


def test_an_upload_that_is_ended_meanwhile_is_gone(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    client, first = service.client(), service.client()
    at = created(client, new_acquisition(client), "photo", len(PHOTO))
    look = Uploads._current

    def overtaken(self: Uploads, upload_id: str, principal: Principal) -> tuple[Upload, bool]:
        found = look(self, upload_id, principal)
        monkeypatch.setattr(Uploads, "_current", look)
        assert first.delete(at, headers=TUS).status_code == 204
        return found

    monkeypatch.setattr(Uploads, "_current", overtaken)
    answer = patch(client, at, PHOTO, 0)
    assert (answer.status_code, answer.json()["code"]) == (410, "upload_gone")


def test_a_dead_connection_gives_way(service: Running, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tus_store, "TAKEOVER_SECONDS", 0.3)
    data = noise(6_000_000)
    client = service.client()
    at = created(client, new_acquisition(client), "cube", len(data), "x.raw")
    key = client.headers["Authorization"].removeprefix("Bearer ")
    connection = begun(service.url, at, key, data, 0, 3_000_000)  # then the network falls away without a word
    offset = until_offset(client, at, 2_000_000)
    answer = patch(client, at, data[offset:], offset)
    if answer.status_code == 409:  # the dead one's last bytes were written when it gave way
        offset = offset_of(client, at)
        answer = patch(client, at, data[offset:], offset)
    assert answer.status_code == 204, answer.text
    connection.close()
    assert result(client, at)["file"]["sha256"] == hashlib.sha256(data).hexdigest()


@pytest.mark.slow
def test_a_disk_that_fills_up_in_the_middle(tmp_path: Path) -> None:
    data = noise(20_000_000)
    key = key_in(tmp_path)
    with process_serving(tmp_path, largest_file=5_000_000) as (_, url), client_at(url, key) as client:
        at = created(client, new_acquisition(client), "cube", len(data), "x.raw")
        # So much that the last, smaller write fails: the answer comes when all has been read, and is not cut off.
        full = patch(client, at, data[:5_200_000], 0)
        assert (full.status_code, full.json()["code"]) == (507, "storage_full")
        assert offset_of(client, at) == 5_000_000
        assert client.get("/readyz").status_code == 200
    with process_serving(tmp_path) as (_, url), client_at(url, key) as client:
        assert offset_of(client, at) == 5_000_000
        assert patch(client, at, data[5_000_000:], 5_000_000).status_code == 204
        assert result(client, at)["file"]["sha256"] == hashlib.sha256(data).hexdigest()
