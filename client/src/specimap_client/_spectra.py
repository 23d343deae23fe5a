"""Spectra of some points of a cloud: what is asked for, and the answers as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypedDict

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

LISTED = 10_000
"""Indices or pixels of one request."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Spectra of ``n`` points, and what else of them was asked for.

    ``values`` (n, B) float32, ``indices`` (n,) int64 of the points in the cloud, ``wavelength_nm`` (B,) float32, NaN
    where unknown; ``fields``: by name, such as ``xyz`` (n, 3) float32. As an array it is its values.
    """

    values: NDArray[np.float32]
    indices: NDArray[np.int64]
    wavelength_nm: NDArray[np.float32]
    fields: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.indices)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self.values, dtype, copy=copy)


@dataclass(frozen=True)
class Query:
    """Which points, which bands, which fields."""

    selections: tuple[dict[str, Any], ...]
    """Asked for one after the other; each has one key."""
    bands: dict[str, Any] | None
    wavelength_nm: NDArray[np.float32]
    fields: tuple[str, ...]


class Selection(TypedDict, total=False):
    """Which points, bands and fields: one of ``indices`` to ``nearest``, and what else is wanted."""

    indices: ArrayLike
    """(n,) of points in the cloud; answered in this order."""
    pixels: ArrayLike
    """(n, 2) row, column in the cube; pixels without a point are left out."""
    polygon: ArrayLike
    """(n, 2) row, column of corners in the cube."""
    box: tuple[ArrayLike, ArrayLike]
    """Lowest and highest x, y, z, mm."""
    radius: tuple[ArrayLike, float]
    """Centre x, y, z and radius, mm."""
    nearest: tuple[ArrayLike, int]
    """A place x, y, z, mm, and how many points."""
    nm: tuple[float, float]
    """Bands from and to these wavelengths."""
    bands: ArrayLike
    """Numbers of bands."""
    fields: Sequence[str]
    """Of xyz, normal, rgb, hsi_pixel, sigma_mm, flags; with ``radius`` and ``nearest`` also distance_mm."""


def query(wavelength_nm: NDArray[np.float32], selection: Selection) -> Query:
    """What :meth:`Cloud.spectra` was asked for. Raises ValueError where that is not exactly one selection."""
    indices, pixels, polygon = selection.get("indices"), selection.get("pixels"), selection.get("polygon")
    box, radius, nearest = selection.get("box"), selection.get("radius"), selection.get("nearest")
    nm, bands, fields = selection.get("nm"), selection.get("bands"), selection.get("fields", ())
    selections: list[dict[str, Any]] = []
    if indices is not None:
        selections += [{"indices": part.tolist()} for part in _parts(_integers(indices, "indices", 1))]
    if pixels is not None:
        selections += [{"pixels": part.tolist()} for part in _parts(_integers(pixels, "pixels", 2))]
    if polygon is not None:
        selections.append({"polygon": np.asarray(polygon, float).tolist()})
    if box is not None:
        low, high = box
        selections.append({"box": {"low": _place(low), "high": _place(high)}})
    if radius is not None:
        centre, radius_mm = radius
        selections.append({"radius": {"centre": _place(centre), "radius_mm": float(radius_mm)}})
    if nearest is not None:
        xyz, k = nearest
        selections.append({"nearest": {"xyz": _place(xyz), "k": int(k)}})
    given = (indices, pixels, polygon, box, radius, nearest)
    if sum(part is not None for part in given) != 1:
        raise ValueError("give one of indices, pixels, polygon, box, radius, nearest")
    chosen: NDArray[np.int64] | None = None
    if nm is not None and bands is not None:
        raise ValueError("give nm or bands, not both")
    if nm is not None:
        chosen = np.flatnonzero((wavelength_nm >= nm[0]) & (wavelength_nm <= nm[1]))
    elif bands is not None:
        chosen = _integers(bands, "bands", 1)
    if chosen is None:
        return Query(tuple(selections), None, wavelength_nm, tuple(fields))
    if not len(chosen) or chosen.min() < 0 or chosen.max() >= len(wavelength_nm):
        raise ValueError(f"no such band; the cloud has {len(wavelength_nm)}")
    return Query(tuple(selections), {"indices": chosen.tolist()}, wavelength_nm[chosen], tuple(fields))


def _integers(values: ArrayLike, what: str, axes: int) -> NDArray[np.int64]:
    array = np.asarray(values)
    if array.dtype == bool:
        raise ValueError(f"{what} are numbers, not a mask: np.flatnonzero(mask)")
    if array.size == 0:
        return np.empty((0,) if axes == 1 else (0, 2), np.int64)
    if array.ndim != axes or (axes == 2 and array.shape[1] != 2) or not np.issubdtype(array.dtype, np.integer):
        raise ValueError(f"{what} have the shape {array.shape} and the type {array.dtype}")
    return array.astype(np.int64)


def _parts(values: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    for start in range(0, len(values), LISTED):
        yield values[start : start + LISTED]


def _place(xyz: ArrayLike) -> list[float]:
    place = np.asarray(xyz, float)
    if place.shape != (3,):
        raise ValueError(f"a place has three coordinates, not the shape {place.shape}")
    return [float(value) for value in place]
