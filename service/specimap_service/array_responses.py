"""Arrays as answers: JSON, an Arrow stream or a NumPy file, as the request's Accept header asks."""

from __future__ import annotations

import io
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext
from dataclasses import dataclass
from itertools import chain
from typing import Any, Protocol

import numpy as np
import orjson
import pyarrow as pa
from fastapi import Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from specimap_core.arrays import Array
from specimap_service.errors import NotAcceptableError

JSON = "application/json"
ARROW = "application/vnd.apache.arrow.stream"
NPY = "application/x-npy"
FLOAT = np.dtype(np.float32)
OFFERED = (JSON, ARROW, NPY)
BATCH, BATCH_VALUES = 4096, 2**19
"""Most rows, and most values, that are read, encoded and sent together: what an answer has in memory at a time."""
JSON_BATCH_VALUES = 2**16
"""The same for JSON: the interpreter does nothing else while a piece is encoded, some milliseconds."""
_ARROW_END = b"\xff\xff\xff\xff\x00\x00\x00\x00"

Columns = Mapping[str, Array]
"""Arrays (n,) or (n, m) by name, of one length."""


@dataclass(frozen=True)
class Rows:
    """``count`` rows of ``width`` values each; ``read(start, stop)`` gives some."""

    count: int
    width: int
    read: Callable[[int, int], Array]


class Pace(Protocol):
    """When and where the pieces of a long answer are made."""

    def sending(self) -> AbstractAsyncContextManager[None]:
        """Hold what a long answer needs while it is sent. Raises TooManyAtOnceError, OverloadedError."""

    async def read(self, work: Callable[..., bytes], *arguments: Any) -> bytes:
        """Make one piece in a thread."""


class _AtOnce:
    def sending(self) -> AbstractAsyncContextManager[None]:
        return nullcontext()

    async def read(self, work: Callable[..., bytes], *arguments: Any) -> bytes:
        return await run_in_threadpool(work, *arguments)


AT_ONCE: Pace = _AtOnce()
"""Each piece as soon as the one before has been sent."""


def documented_responses(model: Any) -> dict[int | str, dict[str, Any]]:
    """Return ``responses`` of an operation that answers in all three media types; ``model`` describes the JSON."""
    binary = {"schema": {"type": "string", "format": "binary"}}
    return {200: {"model": model, "content": {ARROW: binary, NPY: binary}}}


def chosen_type(request: Request, offered: Sequence[str] = OFFERED) -> str:
    """Choose the media type of the answer: the one preferred, the first offered among equals.

    Raises:
        NotAcceptableError: none of them fits.
    """
    accepted = [
        _media_and_weight(part) for part in ",".join(request.headers.getlist("accept")).split(",") if part.strip()
    ]
    if not accepted:
        return offered[0]
    best = max(offered, key=lambda media: _quality(media, accepted))
    if _quality(best, accepted) <= 0:
        raise NotAcceptableError(
            "There is no such form of the answer.", advice=f"Accept {', '.join(offered)}.", offered=list(offered)
        )
    return best


def _media_and_weight(part: str) -> tuple[str, float]:
    media, *parameters = (item.strip().lower() for item in part.split(";"))
    weight = next((item[2:] for item in parameters if item.startswith("q=")), "1")
    try:
        return media, float(weight)
    except ValueError:
        return media, 0.0


def _quality(media: str, accepted: list[tuple[str, float]]) -> float:
    for name in (media, f"{media.partition('/')[0]}/*", "*/*"):
        found = [weight for given, weight in accepted if given == name]
        if found:
            return max(found)
    return 0.0


def json_answer(content: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Response:
    """Answer with JSON of plain values and arrays; numbers that are not finite become null."""
    return Response(json_bytes(content), headers=headers, media_type=JSON)


def json_bytes(content: Mapping[str, Any]) -> bytes:
    """Encode as :func:`json_answer` does."""
    return _encoded(content)


def json_rows_answer(
    before: Mapping[str, Any],
    name: str,
    rows: Rows,
    after: Mapping[str, Any] | None = None,
    headers: Mapping[str, str] | None = None,
    pace: Pace = AT_ONCE,
) -> Response:
    """Answer with one JSON object: ``before``, the rows as the array ``name``, ``after``; read as in
    :func:`arrow_answer`.
    """
    batch = max(1, JSON_BATCH_VALUES // max(rows.width, 1))
    head, tail = _encoded(before)[1:-1], _encoded(after or {})[1:-1]
    opening = b"{" + head + (b"," if head else b"") + b'"' + name.encode() + b'":['
    closing = b"]" + (b"," if tail else b"") + tail + b"}"

    def encoded(values: Array) -> bytes:
        return _encoded(np.ascontiguousarray(values))[1:-1]

    first = encoded(rows.read(0, min(batch, rows.count)))
    later = (b"," + encoded(rows.read(a, b)) for a, b in _batches(rows.count, batch))
    return _answer(chain([opening + first], later, [closing]), rows.count <= batch, JSON, headers, pace)


def _encoded(content: object) -> bytes:
    return orjson.dumps(content, default=_plain, option=orjson.OPT_SERIALIZE_NUMPY)


def _plain(value: object) -> object:
    # The encoder itself takes no arrays that are not contiguous.
    if isinstance(value, np.ndarray):
        return np.ascontiguousarray(value) if not value.flags.c_contiguous else value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON")


def arrow_answer(
    rows: int,
    read: Callable[[int, int], Columns],
    metadata: Mapping[str, str],
    headers: Mapping[str, str] | None = None,
    width: int = 1,
    pace: Pace = AT_ONCE,
) -> Response:
    """Answer with an Arrow IPC stream. ``read(start, stop)`` gives the columns of these rows.

    A column (n, m) becomes lists of m; ``width`` is that of the widest. ``metadata`` goes into the schema. The first
    batch is read before the answer begins, so that an error in it still reaches the client; the rest is read while the
    answer is sent, at the ``pace`` given.
    """
    size = batch_rows(width)
    first = _batch(read(0, min(size, rows)))
    schema = first.schema.with_metadata(dict(metadata))
    pieces = chain(
        [schema.serialize().to_pybytes(), first.serialize().to_pybytes()],
        (_batch(read(a, b)).serialize().to_pybytes() for a, b in _batches(rows, size)),
        [_ARROW_END],
    )
    return _answer(pieces, rows <= size, ARROW, headers, pace)


def _batch(columns: Columns) -> pa.RecordBatch:
    return pa.RecordBatch.from_arrays([_column(values) for values in columns.values()], names=list(columns))


def _column(values: Array) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, type=pa.list_(flat.type, values.shape[1]))


def npy_answer(
    shape: tuple[int, ...],
    read: Callable[[int, int], Array],
    headers: Mapping[str, str] | None = None,
    pace: Pace = AT_ONCE,
    dtype: np.dtype[Any] = FLOAT,
) -> Response:
    """Answer with a ``.npy`` file, little-endian; ``read(start, stop)`` gives its rows.

    It is read as in :func:`arrow_answer`.
    """
    head, stored = io.BytesIO(), dtype.newbyteorder("<")

    def raw(start: int, stop: int) -> bytes:
        return np.ascontiguousarray(read(start, stop), stored).tobytes()

    np.lib.format.write_array_header_1_0(head, {"descr": stored.str, "fortran_order": False, "shape": shape})
    rows, size = shape[0], batch_rows(int(np.prod(shape[1:])))
    first = raw(0, min(size, rows))
    pieces = chain([head.getvalue(), first], (raw(a, b) for a, b in _batches(rows, size)))
    length = len(head.getvalue()) + stored.itemsize * int(np.prod(shape))
    return _answer(pieces, rows <= size, NPY, {**(headers or {}), "Content-Length": str(length)}, pace)


# ---- pieces -------------------------------------------------------------------------------------------


def batch_rows(width: int) -> int:
    """Return how many rows of ``width`` values are read, encoded and sent together."""
    return max(1, min(BATCH, BATCH_VALUES // max(width, 1)))


def _batches(rows: int, size: int) -> Iterator[tuple[int, int]]:
    """First row of each batch but the first, and the one after its last."""
    return ((at, min(at + size, rows)) for at in range(size, rows, size))


def _answer(
    pieces: Iterator[bytes], whole: bool, media_type: str, headers: Mapping[str, str] | None, pace: Pace
) -> Response:
    if whole:
        return Response(b"".join(pieces), headers=dict(headers or {}), media_type=media_type)
    return _Paced(pieces, media_type, dict(headers or {}), pace)


class _Paced(StreamingResponse):
    """An answer that is made piece by piece, each only when the one before has been sent."""

    def __init__(self, pieces: Iterator[bytes], media_type: str, headers: dict[str, str], pace: Pace) -> None:
        super().__init__(_made(pieces, pace), headers=headers, media_type=media_type)
        self._pace = pace

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the pieces; what is refused is refused before the answer begins."""
        async with self._pace.sending():
            await super().__call__(scope, receive, send)


async def _made(pieces: Iterator[bytes], pace: Pace) -> AsyncIterator[bytes]:
    while piece := await pace.read(next, pieces, b""):
        yield piece
