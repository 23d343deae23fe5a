"""Uploads: resumed after every kind of break, across processes too, in flat memory."""

from __future__ import annotations

import hashlib
import json
import tracemalloc
from pathlib import Path

import httpx
import numpy as np
import pytest

import specimap_client as sc
from specimap_client import _tus
from tests.support.client_scene import KEY, TusService, client_of, problem

CHUNK = 64 * 1024


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_tus, "CHUNK", CHUNK)


def photo(folder: Path, name: str = "a.jpg", size: int = 5 * CHUNK + 123) -> Path:
    path = folder / name
    path.write_bytes(np.random.default_rng(size).bytes(size))
    return path


def content_of(service: TusService, number: int = 0) -> bytes:
    return bytes(list(service.known.values())[number])


def test_files_arrive_in_chunks_and_are_judged(tmp_path: Path, waits: list[float]) -> None:
    service, photos = TusService(), [photo(tmp_path, "a.jpg"), photo(tmp_path, "b ü.jpg", 10)]
    heard: list[sc.Progress] = []
    with client_of(service) as client:
        files = client.acquisitions.upload("acq_1", photos=photos, progress=heard.append)
    assert [file.path for file in files] == photos
    assert [content_of(service, i) for i in range(2)] == [path.read_bytes() for path in photos]
    assert list(service.metadata.values())[1] == {"acquisition": "acq_1", "role": "photo", "filename": "b ü.jpg"}
    assert service.largest == CHUNK
    assert (files[0].verdict, files[0].refused, files[0].reason) == ("accepted", False, "")
    sent = [progress.total_sent for progress in heard]
    assert sent == sorted(sent)
    assert sent[-1] == heard[-1].total_size == sum(path.stat().st_size for path in photos)
    assert waits == []


def test_refused_photo_says_why_and_what_to_do(tmp_path: Path) -> None:
    verdict = {"verdict": "refused", "code": "photo_blurred", "reason": "It is blurred.", "advice": "Hold still."}
    service = TusService(verdict=verdict)
    with client_of(service) as client:
        (file,) = client.acquisitions.upload("acq_1", photos=str(photo(tmp_path)))
    assert (file.verdict, file.reason, file.advice) == ("refused", "It is blurred.", "Hold still.")


@pytest.mark.parametrize("fault", ["before", "half", "after", "garbled", "503"])
def test_upload_goes_on_after_every_kind_of_break(tmp_path: Path, waits: list[float], fault: str) -> None:
    service, path = TusService(faults=["", fault, "", fault, fault, fault]), photo(tmp_path)
    with client_of(service) as client:
        (file,) = client.acquisitions.upload("acq_1", photos=[path])
    assert content_of(service) == path.read_bytes()
    assert file.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert service.faults == []
    sent = sum(size for method, size in service.requests if method == "PATCH")
    # Each break costs at most the chunk that it broke.
    assert path.stat().st_size <= sent <= path.stat().st_size + 4 * CHUNK
    assert 1 <= len(waits) <= 4
    assert len(service.known) == 1


def test_upload_gives_up_when_nothing_more_arrives(tmp_path: Path, waits: list[float]) -> None:
    service, photos = (
        TusService(faults=["", "", *["before"] * 99]),
        [photo(tmp_path, "a.jpg", 10), photo(tmp_path, "b.jpg")],
    )
    with client_of(service) as client, pytest.raises(sc.UploadFailed) as caught:
        client.acquisitions.upload("acq_1", photos=photos)
    assert [file.name for file in caught.value.files] == ["a.jpg"]
    assert caught.value.upload_id == list(service.known)[1]
    assert caught.value.path == str(photos[1])
    assert len(waits) == 3


def test_slow_progress_is_progress(tmp_path: Path, waits: list[float]) -> None:
    path = photo(tmp_path, size=CHUNK)
    # Each attempt breaks halfway through what is left: more breaks than attempts without progress are allowed.
    service = TusService(faults=["half"] * 8)
    with client_of(service) as client:
        client.acquisitions.upload("acq_1", photos=[path])
    assert content_of(service) == path.read_bytes()


def test_refusals_end_the_upload_with_their_code(tmp_path: Path, waits: list[float]) -> None:
    def handler(request: httpx.Request) -> httpx.Response:
        return problem(413, "quota_exceeded")

    with client_of(handler) as client, pytest.raises(sc.UploadFailed) as caught:
        client.acquisitions.upload("acq_1", photos=[photo(tmp_path)])
    assert caught.value.code == "quota_exceeded"
    assert isinstance(caught.value.__cause__, sc.Refused)


def test_another_process_goes_on_where_one_stopped(tmp_path: Path, waits: list[float]) -> None:
    service, photos = (
        TusService(faults=["", "", "", *["before"] * 4]),
        [photo(tmp_path, "a.jpg", 10), photo(tmp_path, "b.jpg")],
    )
    notes = tmp_path / "upload.json"
    with client_of(service) as client, pytest.raises(sc.UploadFailed):
        client.acquisitions.upload("acq_1", photos=photos, resume_file=notes)
    assert KEY not in notes.read_text()
    before = len(service.requests)
    with client_of(service) as client:
        files = client.acquisitions.upload("acq_1", photos=photos, resume_file=notes)
    assert [file.name for file in files] == ["a.jpg", "b.jpg"]
    assert len(service.known) == 2
    assert content_of(service, 1) == photos[1].read_bytes()
    again = sum(size for method, size in service.requests[before:] if method == "PATCH")
    assert again == photos[1].stat().st_size - 2 * CHUNK
    assert not notes.exists()


def test_noted_uploads_of_another_content_or_that_expired_are_not_gone_on_with(
    tmp_path: Path, waits: list[float]
) -> None:
    service, path, notes = TusService(faults=["", *["before"] * 4]), photo(tmp_path), tmp_path / "upload.json"
    with client_of(service) as client, pytest.raises(sc.UploadFailed):
        client.acquisitions.upload("acq_1", photos=[path], resume_file=notes)
    photo(tmp_path, size=3 * CHUNK)
    service.faults = ["before"] * 4
    with client_of(service) as client, pytest.raises(sc.UploadFailed):
        client.acquisitions.upload("acq_1", photos=[path], resume_file=notes)
    assert [service.sizes[upload] for upload in service.known] == [5 * CHUNK + 123, 3 * CHUNK]
    service.known.clear()
    with client_of(service) as client:
        client.acquisitions.upload("acq_1", photos=[path], resume_file=notes)
    assert content_of(service) == path.read_bytes()


@pytest.mark.parametrize("text", ["", "[]", '{"x": 1}', "\x00"])
def test_damaged_notes_only_cost_time(tmp_path: Path, text: str) -> None:
    service, path, notes = TusService(), photo(tmp_path), tmp_path / "upload.json"
    notes.write_text(text)
    with client_of(service) as client:
        client.acquisitions.upload("acq_1", photos=[path], resume_file=notes)
    assert content_of(service) == path.read_bytes()


def test_file_that_shrinks_or_arrives_changed_is_told(tmp_path: Path, waits: list[float]) -> None:
    path = photo(tmp_path)
    service = TusService()

    def shrinking(request: httpx.Request) -> httpx.Response:
        answer = service(request)
        if request.method == "PATCH":
            path.write_bytes(b"short")
        return answer

    with client_of(shrinking) as client, pytest.raises(sc.UploadFailed) as caught:
        client.acquisitions.upload("acq_1", photos=[path])
    assert caught.value.code == "file_changed"

    def changing(request: httpx.Request) -> httpx.Response:
        answer = TusService.__call__(service, request)
        if request.url.path.endswith("/result"):
            described = json.loads(answer.content)
            described["file"]["sha256"] = "0" * 64
            return httpx.Response(200, json=described)
        return answer

    with client_of(changing) as client, pytest.raises(sc.UploadFailed) as caught:
        client.acquisitions.upload("acq_1", photos=[photo(tmp_path, "c.jpg")])
    assert caught.value.code == "checksum_wrong"


def test_envi_header_brings_its_data(tmp_path: Path) -> None:
    header, data = tmp_path / "Scan.HDR", tmp_path / "scan.raw"
    header.write_text("ENVI")
    with client_of(TusService()) as client, pytest.raises(sc.UploadFailed) as caught:
        client.acquisitions.upload("acq_1", cube=header)
    assert caught.value.code == "cube_not_found"
    data.write_bytes(b"1234")
    (tmp_path / "scan.txt").write_text("not it")
    service = TusService()
    with client_of(service) as client:
        files = client.acquisitions.upload("acq_1", cube=header, white=(data,), dark=[header, data])
    assert [(file.role, file.name) for file in files] == [
        ("cube", "Scan.HDR"),
        ("cube", "scan.raw"),
        ("white", "scan.raw"),
        ("dark", "Scan.HDR"),
        ("dark", "scan.raw"),
    ]
    (tmp_path / "scan.img").write_bytes(b"1234")
    with client_of(service) as client, pytest.raises(sc.UploadFailed, match="Several"):
        client.acquisitions.upload("acq_1", cube=header)


def test_nothing_is_sent_where_a_file_is_missing_or_empty(tmp_path: Path) -> None:
    (tmp_path / "empty.jpg").touch()
    service = TusService()
    for wrong in (tmp_path / "none.jpg", tmp_path / "empty.jpg", tmp_path):
        with client_of(service) as client, pytest.raises(sc.UploadFailed):
            client.acquisitions.upload("acq_1", photos=[photo(tmp_path), wrong])
    assert service.requests == []


def test_upload_holds_one_chunk_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_tus, "CHUNK", 1 << 20)
    path = tmp_path / "cube.npy"
    with path.open("wb") as file:
        file.truncate(64 << 20)
    arrived = 0

    def handler(request: httpx.Request) -> httpx.Response:
        nonlocal arrived
        if request.method == "POST":
            return httpx.Response(201, headers={"Location": "/v1/uploads/up_1"})
        if request.method == "PATCH":
            arrived += len(request.content)
        if request.method != "GET":
            return httpx.Response(204, headers={"Upload-Offset": str(arrived)})
        return problem(500, "internal_error")

    tracemalloc.start()
    try:
        with client_of(handler) as client, pytest.raises(sc.UploadFailed):
            client.acquisitions.upload("acq_1", cube=path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert arrived == 64 << 20
    assert peak < 5 << 20
