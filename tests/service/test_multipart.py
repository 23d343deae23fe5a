"""Forms arrive in pieces of any size, and are read the same."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path
from typing import cast

import pytest
from fastapi import Request

from specimap_service.errors import RequestInvalidError
from specimap_service.uploads.multipart import BATCH, FormFiles

BOUNDARY = "b0undary"


class NoLimits:
    def begin(self, role: str, files: int) -> None: ...

    def grow(self, role: str, size: int, total: int) -> None: ...


class Arriving:
    """A request whose body comes in pieces."""

    def __init__(self, pieces: list[bytes]) -> None:
        self._pieces = pieces
        self.headers = {"content-type": f"multipart/form-data; boundary={BOUNDARY}"}

    async def stream(self) -> AsyncIterator[bytes]:
        for piece in self._pieces:
            yield piece


def form(content: bytes) -> bytes:
    parts = (b'name="role"\r\n\r\nphoto', b'name="file"; filename="a.jpg"\r\n\r\n' + content)
    head = f"--{BOUNDARY}\r\nContent-Disposition: form-data; ".encode()
    return b"".join(head + part + b"\r\n" for part in parts) + f"--{BOUNDARY}--\r\n".encode()


def read(folder: Path, body: bytes, step: int) -> bytes:
    pieces = [body[at : at + step] for at in range(0, len(body), step)]
    files = FormFiles(folder, NoLimits())
    try:
        (part,) = asyncio.run(files.read(cast(Request, Arriving(pieces))))
        return part.path.read_bytes()
    finally:
        files.close()


@pytest.mark.parametrize("size", [1, BATCH - 300, BATCH, 2 * BATCH])
@pytest.mark.parametrize("step", [4096, 65536, BATCH - 1, BATCH, 4 * BATCH])
def test_pieces_of_any_size(tmp_path: Path, size: int, step: int) -> None:
    content = bytes(range(256)) * (size // 256) + b"x" * (size % 256)
    assert read(tmp_path, form(content), step) == content


@pytest.mark.parametrize("step", [4096, 4 * BATCH])
@pytest.mark.parametrize("lost", [3, 40, BATCH])
def test_a_form_that_is_cut_short_is_refused(tmp_path: Path, lost: int, step: int) -> None:
    with pytest.raises(RequestInvalidError):
        read(tmp_path, form(b"y" * (2 * BATCH))[:-lost], step)
    assert list(tmp_path.iterdir()) == []
