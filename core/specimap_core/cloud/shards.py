"""Reading the sharded arrays of a cloud directly: several times faster than through zarr-python.

Only the layout that Specimap writes is read here (sharded along points, blosc); any other is left to zarr-python
where it lies in a folder, so that a cloud which another program rewrote still opens.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from google_crc32c import value as crc32c
from numcodecs import blosc  # type: ignore[import-untyped]
from numpy.typing import NDArray

from specimap_core.arrays import Array
from specimap_core.cloud.source import ByteSource, Folder
from specimap_core.errors import CloudDamagedError, NotFoundError, SpecimapError

_ENTRY_BYTES, _CHECKSUM_BYTES = 16, 4
_ABSENT = 2**64 - 1
_READ_THREADS = 2
_BLOCK_BYTES = 2**25


@contextmanager
def damage(source: ByteSource, name: str) -> Iterator[None]:
    """Turn whatever a reader stumbles on in array ``name`` of a group into CloudDamagedError.

    What the source itself raises on purpose passes, but for a file that is not there.
    """
    try:
        yield
    except NotFoundError as error:
        raise _damaged(source, name, error) from error
    except SpecimapError:
        raise
    except (OSError, ValueError, LookupError, AttributeError, RuntimeError, TypeError) as error:
        raise _damaged(source, name, error) from error


def _damaged(source: ByteSource, name: str, error: Exception) -> CloudDamagedError:
    return CloudDamagedError(
        f"The array {name} of {source.name} cannot be read: {error}.",
        advice="Repeat the run; finished stages are not repeated.",
        array=name,
    )


class PointArray:
    """One array of a cloud, read by ranges of points (its first axis).

    ``shape``, ``dtype``; ``chunk_points``: ranges that begin and end at its multiples are read without waste.
    """

    def __init__(self, group: Path | ByteSource, name: str) -> None:
        """Raises CloudDamagedError."""
        self._source: ByteSource = Folder(group) if isinstance(group, Path) else group
        self._name = name
        self._other: zarr.Array[Any] | None = None
        with damage(self._source, name):
            metadata = json.loads(self._source.read(f"{name}/zarr.json"))
            self.attributes: dict[str, object] = dict(metadata.get("attributes", {}))
            self.shape: tuple[int, ...] = tuple(metadata["shape"])
            if _is_ours(metadata):
                outer = metadata["chunk_grid"]["configuration"]["chunk_shape"]
                inner = metadata["codecs"][0]["configuration"]["chunk_shape"]
                self._shard_points, self.chunk_points = int(outer[0]), int(inner[0])
                self.dtype = np.dtype(metadata["data_type"])
            elif not isinstance(self._source, Folder):
                raise ValueError("it is not laid out as Specimap writes it")
            else:
                self._other = zarr.open_array(self._source.path / name, mode="r", zarr_format=3)
                self.dtype, self.chunk_points = self._other.dtype, self._other.chunks[0]
        self._index = lru_cache(None)(self._read_index)

    @property
    def point_bytes(self) -> int:
        """Bytes of a point's values."""
        return int(np.prod(self.shape[1:], dtype=np.int64)) * int(self.dtype.itemsize)

    def read(self, start: int, stop: int, out: Array | None = None) -> Array:
        """Values (stop - start, ...) of points [start, stop), into ``out`` if given.

        Raises CloudDamagedError.
        """
        out = np.empty((stop - start, *self.shape[1:]), self.dtype) if out is None else out
        with damage(self._source, self._name):
            if self._other is not None:
                out[...] = np.asarray(self._other[start:stop])
                return out
            at = start
            while at < stop:
                shard = at // self._shard_points
                end = min(stop, (shard + 1) * self._shard_points)
                self._read_from_shard(shard, at, end, out[at - start : end - start])
                at = end
        return out

    def blocks(self, points: int, start: int = 0, stop: int | None = None) -> Iterator[tuple[int, Array]]:
        """First point and values of consecutive blocks of at most ``points``, read ahead by two threads.

        Blocks are smaller where a point has more values than usual.
        """
        stop = self.shape[0] if stop is None else stop
        points = min(points, _BLOCK_BYTES // max(1, self.point_bytes))
        points = max(1, points // self.chunk_points) * self.chunk_points
        # Blocks after the first begin where a chunk begins.
        edges = [start, *range((start // points + 1) * points, stop, points), stop]
        waiting: list[tuple[int, Future[Array]]] = []
        with ThreadPoolExecutor(_READ_THREADS, "cloud-reader") as pool:
            for a, b in pairwise(edges):
                waiting.append((a, pool.submit(self.read, a, b)))
                if len(waiting) > _READ_THREADS:
                    first, block = waiting.pop(0)
                    yield first, block.result()
            for first, block in waiting:
                yield first, block.result()

    def _read_from_shard(self, shard: int, start: int, stop: int, out: Array) -> None:
        index = self._index(shard)
        size, base = self.chunk_points, shard * self._shard_points
        inner = range((start - base) // size, -(-(stop - base) // size))
        entries = index[inner.start : inner.stop]
        if (entries[:, 0] == _ABSENT).any():
            raise ValueError("a chunk is missing")
        low, high = int(entries[:, 0].min()), int(entries.sum(1).max())
        # Chunks that were written together lie together: one read fetches them all.
        content = memoryview(self._source.read(self._file(shard), low, high))
        if len(content) != high - low:
            raise ValueError("a shard is truncated")
        whole: Array | None = None
        for i, (offset, length) in zip(inner, entries.tolist(), strict=True):
            compressed = content[offset - low : offset - low + length]
            first = base + i * size
            if first >= start and first + size <= stop:
                blosc.decompress(compressed, out[first - start : first - start + size])
                continue
            if whole is None:
                whole = np.empty((size, *self.shape[1:]), self.dtype)
            blosc.decompress(compressed, whole)
            a, b = max(first, start), min(first + size, stop)
            out[a - start : b - start] = whole[a - first : b - first]

    def _read_index(self, shard: int) -> NDArray[np.uint64]:
        """Offset and length in bytes (chunks, 2) of the chunks in a shard's file."""
        size = self._shard_points // self.chunk_points * _ENTRY_BYTES
        file = self._file(shard)
        end = self._source.size(file)
        if end < size + _CHECKSUM_BYTES:
            raise ValueError("a shard is truncated")
        content = self._source.read(file, end - size - _CHECKSUM_BYTES, end)
        if crc32c(content[:size]) != int.from_bytes(content[size:], "little"):
            raise ValueError("the checksum of a shard's index is wrong")
        return np.frombuffer(content[:size], "<u8").reshape(-1, 2)

    def _file(self, shard: int) -> str:
        return "/".join([self._name, "c", str(shard), *["0"] * (len(self.shape) - 1)])


def _is_ours(metadata: dict[str, Any]) -> bool:
    """Whether the array is sharded along its first axis only, its chunks little-endian blosc."""
    match metadata:
        case {
            "shape": [_, *shape],
            "chunk_grid": {"configuration": {"chunk_shape": [_, *outer]}},
            "chunk_key_encoding": {"name": "default", **keys},
            "codecs": [
                {
                    "name": "sharding_indexed",
                    "configuration": {
                        "chunk_shape": [_, *inner],
                        "codecs": [{"name": "bytes", **order}, {"name": "blosc"}],
                        "index_codecs": [{"name": "bytes"}, {"name": "crc32c"}],
                        **rest,
                    },
                }
            ],
        }:
            # Each may be left out: single bytes have no order, and these are the defaults.
            little = order in ({}, {"configuration": {"endian": "little"}})
            slashes = keys in ({}, {"configuration": {"separator": "/"}})
            last = rest in ({}, {"index_location": "end"})
            return little and slashes and last and inner == outer == shape
    return False
