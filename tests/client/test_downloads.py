"""Downloads: gone on with where they broke, and only with the same file."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

import specimap_client as sc
from specimap_client._downloads import chunk_keys, fetch
from tests.support.client_scene import client_of

CONTENT = np.random.default_rng(3).bytes(10_000)
OTHER = np.random.default_rng(4).bytes(9_000)


class _Cut(httpx.SyncByteStream):
    def __init__(self, content: bytes) -> None:
        self._content = content

    def __iter__(self) -> Iterator[bytes]:
        yield from (self._content[i : i + 100] for i in range(0, len(self._content), 100))
        raise httpx.ReadError("cut")


class Files:
    """One file, whose answers are cut after some bytes; the last number of ``cuts`` is for ever."""

    def __init__(self, *cuts: int, etag: str | None = '"one"', ranges: bool = True) -> None:
        self.content, self.etag, self.cuts, self.ranges = CONTENT, etag, list(cuts), ranges
        self.asked: list[str | None] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        """Answer a GET."""
        asked, tag = request.headers.get("Range"), request.headers.get("If-Range")
        self.asked.append(asked)
        headers = {"ETag": self.etag} if self.etag else {}
        start = 0
        if asked and self.ranges and tag == self.etag:
            start = int(asked.removeprefix("bytes=").rstrip("-"))
            if start >= len(self.content):
                return httpx.Response(416, headers={"Content-Range": f"bytes */{len(self.content)}"})
            headers["Content-Range"] = f"bytes {start}-{len(self.content) - 1}/{len(self.content)}"
        body = self.content[start:]
        headers["Content-Length"] = str(len(body))
        cut = self.cuts.pop(0) if len(self.cuts) > 1 else self.cuts[0]
        stream = httpx.ByteStream(body) if cut >= len(body) else _Cut(body[:cut])
        return httpx.Response(206 if "Content-Range" in headers else 200, headers=headers, stream=stream)


def load(files: Files, target: Path) -> list[tuple[int, int]]:
    heard: list[tuple[int, int]] = []
    with client_of(files) as client:
        fetch(client._session, "v1/file", target, lambda have, total: heard.append((have, total)))
    return heard


def test_broken_download_goes_on(tmp_path: Path, waits: list[float]) -> None:
    files, target = Files(3000, 2000, 10_000), tmp_path / "a.bin"
    heard = load(files, target)
    assert target.read_bytes() == CONTENT
    assert files.asked == [None, "bytes=3000-", "bytes=5000-"]
    assert heard[-1] == (10_000, 10_000)
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


def test_another_process_goes_on(tmp_path: Path, waits: list[float]) -> None:
    target = tmp_path / "a.bin"
    with pytest.raises(sc.ConnectionFailed):
        load(Files(3000, 0), target)
    assert not target.exists()
    files = Files(10_000)
    load(files, target)
    assert files.asked == ["bytes=3000-"]
    assert target.read_bytes() == CONTENT


@pytest.mark.parametrize("ranges", [True, False])
def test_changed_file_begins_anew(tmp_path: Path, waits: list[float], ranges: bool) -> None:
    target = tmp_path / "a.bin"
    with pytest.raises(sc.ConnectionFailed):
        load(Files(9500, 0), target)
    changed = Files(10_000, ranges=ranges)
    changed.content, changed.etag = OTHER, '"two"'
    load(changed, target)
    assert target.read_bytes() == OTHER


def test_file_that_became_shorter_under_the_same_tag_begins_anew(tmp_path: Path, waits: list[float]) -> None:
    target = tmp_path / "a.bin"
    with pytest.raises(sc.ConnectionFailed):
        load(Files(9500, 0), target)
    shorter = Files(10_000)
    shorter.content = OTHER
    load(shorter, target)
    assert target.read_bytes() == OTHER


@pytest.mark.parametrize("etag", [None, 'W/"one"'])
def test_without_a_strong_tag_all_is_read_again(tmp_path: Path, waits: list[float], etag: str | None) -> None:
    files, target = Files(3000, 10_000, etag=etag), tmp_path / "a.bin"
    load(files, target)
    assert files.asked == [None, None]
    assert target.read_bytes() == CONTENT


def test_keys_of_chunks_follow_from_the_metadata() -> None:
    metadata = {
        "node_type": "array",
        "shape": [300_000, 7],
        "chunk_key_encoding": {"name": "default"},
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [131_072, 7]}},
    }
    assert list(chunk_keys(metadata)) == ["c/0/0", "c/1/0", "c/2/0"]
    assert list(chunk_keys({"node_type": "group"})) == []
    for wrong in ({"node_type": "array"}, metadata | {"chunk_key_encoding": {"name": "v2"}}):
        with pytest.raises(sc.UnexpectedAnswer):
            list(chunk_keys(wrong))


@pytest.mark.parametrize("name", ["../x", "a/../../x", "/x", "a//b", "..", ""])
def test_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    def handler(request: httpx.Request) -> httpx.Response:
        members = {name: {"node_type": "group"}}
        return httpx.Response(200, json={"node_type": "group", "consolidated_metadata": {"metadata": members}})

    from specimap_client._downloads import fetch_zarr

    with client_of(handler) as client, pytest.raises(sc.UnexpectedAnswer):
        fetch_zarr(client._session, "cloud_1", tmp_path / "cloud.zarr")
    assert list(tmp_path.iterdir()) == []
