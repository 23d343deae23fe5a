"""Arrays as answers: JSON, an Arrow stream or a NumPy file, as the request's Accept header asks."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import orjson
import pyarrow as pa
from fastapi import Request
from starlette.responses import Response, StreamingResponse

from specimap_core.arrays import Array
from specimap_service.errors import NotAcceptableError

JSON = "application/json"
ARROW = "application/vnd.apache.arrow.stream"
NPY = "application/x-npy"
OFFERED = (JSON, ARROW, NPY)
BATCH = 4096
"""Rows that are read, encoded and sent together: the part of an answer that is in memory at a time."""
_ARROW_END = b"\xff\xff\xff\xff\x00\x00\x00\x00"

Columns = Mapping[str, Array]
"""Arrays (n,) or (n, m) by name, of one length."""


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
) -> Response:
    """Answer with an Arrow IPC stream. ``read(start, stop)`` gives the columns of these rows.

    A column (n, m) becomes lists of m. ``metadata`` goes into the schema. The first batch is read before the answer
    begins, so that an error in it still reaches the client; the rest is read while the answer is sent.
    """
    first = _batch(read(0, min(BATCH, rows)))
    schema = first.schema.with_metadata(dict(metadata))
    later = (_batch(read(at, min(at + BATCH, rows))) for at in range(BATCH, rows, BATCH))
    pieces = chain(
        [schema.serialize().to_pybytes(), first.serialize().to_pybytes()],
        (batch.serialize().to_pybytes() for batch in later),
        [_ARROW_END],
    )
    if rows <= BATCH:
        return Response(b"".join(pieces), headers=dict(headers or {}), media_type=ARROW)
    return StreamingResponse(pieces, headers=dict(headers or {}), media_type=ARROW)


def _batch(columns: Columns) -> pa.RecordBatch:
    return pa.RecordBatch.from_arrays([_column(values) for values in columns.values()], names=list(columns))


def _column(values: Array) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, type=pa.list_(flat.type, values.shape[1]))


def npy_answer(
    shape: tuple[int, ...], read: Callable[[int, int], Array], headers: Mapping[str, str] | None = None
) -> Response:
    """Answer with a ``.npy`` file of little-endian float32; ``read(start, stop)`` gives its rows.

    It is read as in :func:`arrow_answer`.
    """
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f4", "fortran_order": False, "shape": shape})
    rows = shape[0]
    first = _raw(read(0, min(BATCH, rows)))
    pieces: Iterator[bytes] = chain(
        [head.getvalue(), first], (_raw(read(at, min(at + BATCH, rows))) for at in range(BATCH, rows, BATCH))
    )
    if rows <= BATCH:
        return Response(b"".join(pieces), headers=dict(headers or {}), media_type=NPY)
    length = len(head.getvalue()) + 4 * int(np.prod(shape))
    return StreamingResponse(pieces, headers={**(headers or {}), "Content-Length": str(length)}, media_type=NPY)


def _raw(values: Array) -> bytes:
    return np.ascontiguousarray(values, "<f4").tobytes()
