"""Pages of spectra: as Arrow where pyarrow is there, else the values as npy and the rest as JSON."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from specimap_client._errors import UnexpectedAnswer
from specimap_client._http import JSON, Session, json_of, path
from specimap_client._spectra import Query, Spectra

ARROW = "application/vnd.apache.arrow.stream"
NPY = "application/x-npy"
_NEXT = "X-Specimap-Next-Offset"
_MOST_JSON = 10_000
_FIELDS: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "xyz": (np.float32, (3,)),
    "normal": (np.float32, (3,)),
    "rgb": (np.uint8, (3,)),
    "hsi_pixel": (np.uint16, (2,)),
    "sigma_mm": (np.float32, ()),
    "flags": (np.uint8, ()),
    "distance_mm": (np.float32, ()),
}
"""Type and width of what JSON tells without them."""


def pages(session: Session, cloud: str, query: Query, page: int) -> Iterator[Spectra]:
    """The answers to a query, at most ``page`` points each. The same request may be repeated: it only reads."""
    address = path("clouds", cloud, "spectra")
    arrow = has_arrow()
    page = page if arrow else min(page, _MOST_JSON)
    for selection in query.selections:
        offset: int | None = 0
        while offset is not None:
            body = {
                "select": selection,
                "bands": query.bands,
                "fields": list(query.fields),
                "limit": page,
                "offset": offset,
            }
            found, offset = (_by_arrow if arrow else _by_npy)(session, address, body, query)
            yield found


def gathered(found: list[Spectra], query: Query) -> Spectra:
    """Pages as one; without pages there is nothing in it."""
    if len(found) == 1:
        return found[0]
    if not found:
        fields = {name: _field(name, []) for name in query.fields}
        values = np.empty((0, len(query.wavelength_nm)), np.float32)
        return Spectra(values, np.empty(0, np.int64), query.wavelength_nm, fields)
    return Spectra(
        np.concatenate([page.values for page in found]),
        np.concatenate([page.indices for page in found]),
        query.wavelength_nm,
        {name: np.concatenate([page.fields[name] for page in found]) for name in query.fields},
    )


def has_arrow() -> bool:
    """Whether pyarrow can be imported."""
    try:
        import pyarrow.ipc  # noqa: F401
    except ImportError:
        return False
    return True


def npy_of(answer: httpx.Response) -> NDArray[Any]:
    """The array of an npy answer.

    Raises:
        UnexpectedAnswer: it is none.
    """
    try:
        array: NDArray[Any] = np.load(io.BytesIO(answer.content), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise UnexpectedAnswer(f"{answer.request.url.path} answered with no array.") from error
    return array


def _field(name: str, values: list[Any]) -> NDArray[Any]:
    kind, width = _FIELDS.get(name, (np.float32, ()))
    return np.asarray(values, kind).reshape(len(values), *width)


def _next(answer: httpx.Response) -> int | None:
    header = answer.headers.get(_NEXT)
    return None if header is None else int(header)


def _by_arrow(session: Session, address: str, body: dict[str, Any], query: Query) -> tuple[Spectra, int | None]:
    import pyarrow as pa

    answer = session.request("POST", address, json=body, headers={"Accept": ARROW}, safe=True)
    try:
        with pa.ipc.open_stream(answer.content) as reader:
            table = reader.read_all()
        columns = {name: _column(table.column(name)) for name in table.column_names}
        values = columns["spectrum"].reshape(table.num_rows, len(query.wavelength_nm))
        fields = {name: columns[name] for name in query.fields}
        return Spectra(values, columns["index"].astype(np.int64), query.wavelength_nm, fields), _next(answer)
    except (pa.ArrowInvalid, KeyError, ValueError) as error:
        raise UnexpectedAnswer("The table of spectra is not of the expected form.") from error


def _column(column: Any) -> NDArray[Any]:
    """A column as an array; lists of fixed length become its second axis."""
    import pyarrow as pa

    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):  # older releases, and columns without rows
        array = pa.concat_arrays(array.chunks) if array.num_chunks else pa.array([], column.type)
    if pa.types.is_fixed_size_list(array.type):
        return np.asarray(array.flatten().to_numpy(zero_copy_only=False)).reshape(len(array), array.type.list_size)
    return np.asarray(array.to_numpy(zero_copy_only=False))


def _by_npy(session: Session, address: str, body: dict[str, Any], query: Query) -> tuple[Spectra, int | None]:
    answer = session.request("POST", address, json=body, headers={"Accept": NPY}, safe=True)
    values = npy_of(answer)
    # One band suffices for what npy does not carry.
    rest = json_of(
        session.request("POST", address, json=body | {"bands": {"indices": [0]}}, headers={"Accept": JSON}, safe=True)
    )
    try:
        indices = np.asarray(rest["indices"], np.int64)
        fields = {name: _field(name, rest["fields"][name]) for name in query.fields}
    except (KeyError, TypeError, ValueError) as error:
        raise UnexpectedAnswer("The answer does not say which points it is about.") from error
    if values.shape != (len(indices), len(query.wavelength_nm)):
        raise UnexpectedAnswer("Spectra and points do not fit each other.")
    return Spectra(values, indices, query.wavelength_nm, fields), _next(answer)
