"""A cloud's stored bytes as a read-only Zarr store, over the client's own connections.

Not a store of obstore or fsspec: those bring connections of their own, without the client's certificates, proxies,
retries, errors and transport, and put the key into pickles. Imported only where zarr is asked for.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable
from typing import Never

import httpx
from zarr.abc.store import ByteRequest, OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype

from specimap_client._errors import NotFound
from specimap_client._http import Session, path


class CloudStore(Store):
    """The files of one cloud. What there is, the group's consolidated metadata tell."""

    def __init__(self, session: Session, cloud: str) -> None:
        super().__init__(read_only=True)
        self._session = session
        self._cloud = cloud

    def __eq__(self, value: object) -> bool:
        return isinstance(value, CloudStore) and (value._session, value._cloud) == (self._session, self._cloud)

    def __repr__(self) -> str:
        return f"<CloudStore {self._cloud} at {self._session.url}>"

    def __getstate__(self) -> Never:
        raise TypeError("a cloud over HTTP holds a key and is not pickled: open it in each process")

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """The bytes of a file, or a range of them; None where there is no such file."""
        content = await asyncio.to_thread(self._read, key, byte_range)
        return None if content is None else prototype.buffer.from_bytes(content)

    async def get_partial_values(
        self, prototype: BufferPrototype, key_ranges: Iterable[tuple[str, ByteRequest | None]]
    ) -> list[Buffer | None]:
        """As :meth:`get`, several side by side."""
        return list(await asyncio.gather(*(self.get(key, prototype, wanted) for key, wanted in key_ranges)))

    async def exists(self, key: str) -> bool:
        """Whether there is such a file."""
        return await asyncio.to_thread(self._exists, key)

    def _address(self, key: str) -> str:
        return path("clouds", self._cloud, "zarr", *key.split("/"))

    def _read(self, key: str, wanted: ByteRequest | None) -> bytes | None:
        headers = {} if wanted is None else {"Range": _range(wanted)}
        try:
            answer = self._session.request("GET", self._address(key), headers=headers)
        except NotFound:
            return None
        if wanted is not None and answer.status_code != httpx.codes.PARTIAL_CONTENT:
            # Something in between dropped Range: the answer is the whole file.
            return _part(answer.content, wanted)
        return answer.content

    def _exists(self, key: str) -> bool:
        try:
            self._session.request("HEAD", self._address(key))
        except NotFound:
            return False
        return True

    # ---- what a cloud over HTTP does not do -------------------------------------------------------------

    @property
    def supports_writes(self) -> bool:
        """No: labels are written by ``put_label``."""
        return False

    @property
    def supports_deletes(self) -> bool:
        """No."""
        return False

    @property
    def supports_listing(self) -> bool:
        """No."""
        return False

    async def set(self, key: str, value: Buffer) -> None:
        """Not possible: ValueError."""
        self._check_writable()

    async def delete(self, key: str) -> None:
        """Not possible: ValueError."""
        self._check_writable()

    def list(self) -> AsyncIterator[str]:
        """Not possible."""
        raise NotImplementedError("files are not listed over HTTP")

    def list_prefix(self, prefix: str) -> AsyncIterator[str]:
        """Not possible."""
        raise NotImplementedError("files are not listed over HTTP")

    def list_dir(self, prefix: str) -> AsyncIterator[str]:
        """Not possible."""
        raise NotImplementedError("files are not listed over HTTP")


def _range(wanted: ByteRequest) -> str:
    if isinstance(wanted, RangeByteRequest):
        return f"bytes={wanted.start}-{wanted.end - 1}"
    if isinstance(wanted, OffsetByteRequest):
        return f"bytes={wanted.offset}-"
    return f"bytes=-{wanted.suffix}"


def _part(content: bytes, wanted: ByteRequest) -> bytes:
    if isinstance(wanted, RangeByteRequest):
        return content[wanted.start : wanted.end]
    if isinstance(wanted, OffsetByteRequest):
        return content[wanted.offset :]
    return content[max(0, len(content) - wanted.suffix) :]
