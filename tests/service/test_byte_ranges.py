"""Byte ranges, ETags and long files: what a stored file is to an HTTP client."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator

import httpx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from specimap_service import byte_ranges
from tests.support.result_scene import Result, put_result
from tests.support.service_scene import Running, serving

SHARD = "spectra/c/0/0"
LARGE = "spectra/c/9/0"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with serving(tmp_path_factory.mktemp("ranges")) as running:
        yield running


@pytest.fixture(scope="module")
def result(service: Running, tmp_path_factory: pytest.TempPathFactory) -> Result:
    return put_result(service, tmp_path_factory.mktemp("result") / "local")


@pytest.fixture(scope="module")
def reader(service: Running, result: Result) -> httpx.Client:
    client = service.client(("read",))
    client.base_url = httpx.URL(f"{service.url}/v1/clouds/{result.cloud_id}/zarr/")
    return client


@pytest.fixture(scope="module")
def large(service: Running, result: Result) -> bytes:
    """A file of many pieces, as large shards are."""
    content = np.random.default_rng(0).bytes(24 * byte_ranges.PIECE + 12345)
    service.storage.put(f"{result.prefix}/cloud.zarr/{LARGE}", content)
    return content


def expected(header: str, size: int) -> tuple[int, int] | int | None:
    """What RFC 9110 says of one range: its bytes, None for the whole file, 416."""
    unit, _, spec = header.partition("=")
    first, dash, last = spec.partition("-")
    if unit != "bytes" or not dash or not (first + last).isascii() or not (first + last).isdigit():
        return None
    if not first:
        return (max(size - int(last), 0), size) if int(last) else 416
    if last and int(last) < int(first):
        return None
    if int(first) >= size:
        return 416
    return int(first), min(int(last) + 1, size) if last else size


numbers = st.integers(0, 70_000) | st.integers(0, 26_000_000)
headers = st.one_of(
    st.tuples(numbers, numbers).map(lambda ab: f"bytes={ab[0]}-{ab[1]}"),
    st.tuples(numbers, st.integers(0, 3000)).map(lambda ab: f"bytes={ab[0]}-{ab[0] + ab[1]}"),
    numbers.map(lambda a: f"bytes={a}-"),
    numbers.map(lambda a: f"bytes=-{a}"),
    st.sampled_from(["bytes=", "bytes=-", "bytes=a-b", "bytes=1", "lines=1-2", "bytes=--5", "bytes=1-2-3", "x"]),
)


@pytest.mark.slow
@given(header=headers, which=st.booleans())
@settings(max_examples=120, deadline=None)
def test_ranges_are_the_files_bytes(
    reader: httpx.Client, result: Result, large: bytes, header: str, which: bool
) -> None:
    content = large if which else (result.local / "cloud.zarr" / SHARD).read_bytes()
    answer = reader.get(LARGE if which else SHARD, headers={"Range": header})
    want = expected(header, len(content))
    if want == 416:
        assert (answer.status_code, answer.json()["code"]) == (416, "range_not_satisfiable")
        assert answer.headers["content-range"] == f"bytes */{len(content)}"
    elif isinstance(want, tuple):
        start, stop = want
        assert answer.status_code == 206
        assert answer.headers["content-range"] == f"bytes {start}-{stop - 1}/{len(content)}"
        assert answer.content == content[start:stop]
    else:
        assert (answer.status_code, answer.content == content) == (200, True)
        assert "content-range" not in answer.headers
    assert answer.headers["accept-ranges"] == "bytes"


def test_several_ranges_get_the_whole_file(reader: httpx.Client, result: Result) -> None:
    answer = reader.get(SHARD, headers={"Range": "bytes=0-1,5-6"})
    assert answer.status_code == 200
    assert answer.content == (result.local / "cloud.zarr" / SHARD).read_bytes()


def test_head_says_what_get_would_send(reader: httpx.Client, large: bytes) -> None:
    for key in (SHARD, LARGE, "zarr.json"):
        head, get = reader.head(key, headers={"Range": "bytes=0-4"}), reader.get(key)
        assert (head.status_code, head.content) == (200, b"")
        for name in ("content-length", "etag", "content-type", "accept-ranges", "cache-control"):
            assert head.headers[name] == get.headers[name]
    assert reader.head("spectra/c/5/0").status_code == 404


def test_etags(reader: httpx.Client) -> None:
    etag = reader.get(SHARD).headers["etag"]
    assert reader.get(SHARD).headers["etag"] == etag != reader.get("xyz/c/0/0").headers["etag"]
    for known in (etag, f"W/{etag}", f'"other", {etag}', "*"):
        answer = reader.get(SHARD, headers={"If-None-Match": known, "Range": "bytes=0-4"})
        assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
    assert reader.get(SHARD, headers={"If-None-Match": '"other"'}).status_code == 200
    date = "Sun, 06 Nov 1994 08:49:37 GMT"
    for condition, status in ((etag, 206), ('"other"', 200), (f"W/{etag}", 200), (date, 200)):
        answer = reader.get(SHARD, headers={"If-Range": condition, "Range": "bytes=0-4"})
        assert (answer.status_code, len(answer.content) == 5) == (status, status == 206)
    assert reader.get(SHARD, headers={"If-Match": etag}).status_code == 200
    failed = reader.get(SHARD, headers={"If-Match": f'W/{etag}, "other"'})
    assert (failed.status_code, failed.json()["code"]) == (412, "precondition_failed")


def test_a_file_deleted_while_it_is_sent_arrives_whole(service: Running, result: Result, large: bytes) -> None:
    key = f"{result.prefix}/cloud.zarr/rgb/c/7/0"
    service.storage.put(key, large)
    client = service.client(("read",))
    with client.stream("GET", f"/v1/clouds/{result.cloud_id}/zarr/rgb/c/7/0") as answer:
        pieces = answer.iter_raw()
        got = next(pieces)
        service.storage.delete(key)
        assert got + b"".join(pieces) == large
    assert client.get(f"/v1/clouds/{result.cloud_id}/zarr/rgb/c/7/0").status_code == 404


def test_reading_stops_when_the_client_goes(
    service: Running, result: Result, large: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, pieces = byte_ranges._InFolder.read, []

    def counted(self: byte_ranges._InFolder, start: int, stop: int) -> bytes:
        pieces.append(start)
        return read(self, start, stop)

    monkeypatch.setattr(byte_ranges._InFolder, "read", counted)
    admin = service.client()
    line = 'handle_seconds_count{method="GET",route="/v1/clouds/{cloud_id}/zarr/{key:path}",status="200"}'

    def finished() -> float:
        found = [row for row in admin.get("/metrics").text.splitlines() if line in row]
        return float(found[0].rsplit(" ", 1)[1]) if found else 0.0

    before = finished()
    host, port = service.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as raw:
        path = f"/v1/clouds/{result.cloud_id}/zarr/{LARGE}"
        raw.sendall(f"GET {path} HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {service.key()}\r\n\r\n".encode())
        assert raw.recv(100).startswith(b"HTTP/1.1 200")
    deadline = time.monotonic() + 20
    while finished() == before:
        assert time.monotonic() < deadline
    assert 0 < len(pieces) < 20 < len(large) / byte_ranges.PIECE
