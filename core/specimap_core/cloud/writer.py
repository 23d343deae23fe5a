"""Writing a spectral cloud: a Zarr v3 group, streamed from the cube, whole or not at all."""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import tensorstore
from numpy.typing import NDArray

from specimap_core import __version__
from specimap_core.arrays import Array
from specimap_core.atomic import atomic_path
from specimap_core.cloud.encoding import Encoding, EncodingCounts, SpectraEncoder, strips
from specimap_core.cloud.schema import ARRAYS, SHARD_POINTS, CloudPoints, Flag, SpectraSource, chunk_bounds, tile_order
from specimap_core.cloud.write_summary import WriteSummary
from specimap_core.errors import RegistrationError
from specimap_core.json_text import json_text

UNITS = {"length": "mm", "wavelength": "nm"}


def write_cloud(
    path: Path,
    points: CloudPoints,
    source: SpectraSource,
    attributes: Mapping[str, object] | Callable[[WriteSummary], Mapping[str, object]],
    *,
    progress: Callable[[float], None] | None = None,
    saturation: float | None = None,
    durable: bool = False,
) -> WriteSummary:
    """Write the cloud of ``points`` with the spectra of ``source`` to the group ``path``, replacing it.

    The points are brought to the order of 16x16 tiles. Reflectance is stored in steps of 1e-4, counts as they are where
    they fit 16 bits; ``scale_factor`` and ``add_offset`` of ``spectra`` decode both, and hold negative and large values
    too. What is no finite number is stored as ``_FillValue``; its point is flagged NO_DATA if the band is good. Few
    values far beyond all others are clipped and counted.

    ``attributes`` go to the group, besides version, frame, units and bad bands; they may depend on what was found.
    ``saturation``: the value from which a band counts as saturated (default: the source's). ``progress`` hears
    fractions up to 1. ``durable`` waits until the disk has it all, which can double the time.

    Raises RegistrationError without points, ValueError for points that do not fit each other or the cube,
    StorageFullError, OutputNotWritableError. After an exception the earlier content of ``path`` stands.
    """
    points = _checked(points, source)
    order = tile_order(points.hsi_pixel)
    points = CloudPoints(**{name: values[order] for name, values in vars(points).items()})
    del order
    with atomic_path(path) as group, _storage_errors():
        group.mkdir()
        encoding = Encoding.of(source)
        found, counts = _write_spectra(group, points, source, encoding, saturation, durable, progress)
        flags = points.flags | found
        for name, values in vars(replace(points, flags=flags)).items():
            _write_array(group, name, values, durable)
        _write_array(group, "chunk_aabb", chunk_bounds(points.xyz), durable)
        _write_array(group, "wavelength_nm", np.asarray(source.wavelengths_nm, np.float32), durable)
        own = {
            "specimap_version": __version__,
            "frame": "marker",
            "units": UNITS,
            "bad_bands": np.flatnonzero(source.bad_bands),
            "cube_shape": (source.rows, source.cols, source.bands),
        }
        written = _written(found, counts, encoding)
        given = attributes(written) if callable(attributes) else attributes
        _write_group_metadata(group, own | dict(given))
    if progress:
        progress(1.0)
    return written


def _written(flags: NDArray[np.uint8], counts: EncodingCounts, encoding: Encoding) -> WriteSummary:
    return WriteSummary(
        points=len(flags),
        saturated=int(((flags & Flag.SATURATED) > 0).sum()),
        no_data=int(((flags & Flag.NO_DATA) > 0).sum()),
        clipped_below=counts.below,
        clipped_above=counts.above,
        absurd=counts.absurd,
        least=encoding.add_offset,
        largest=encoding.add_offset + encoding.top * encoding.scale_factor,
    )


def _checked(points: CloudPoints, source: SpectraSource) -> CloudPoints:
    """The points in the stored types. Raises as :func:`write_cloud` does."""
    size = len(points)
    arrays: dict[str, Array] = {}
    for name, values in vars(points).items():
        spec = ARRAYS[name]
        shape = (size,) if spec.width is None else (size, spec.width)
        if values.shape != shape:
            raise ValueError(f"{name} has the shape {values.shape}, not {shape}")
        arrays[name] = np.asarray(values, spec.dtype)
    if not size:
        raise RegistrationError(
            "No pixel of the cube has a surface under it.",
            advice="Check that cube and photos show the same specimen and markers.",
        )
    if (points.hsi_pixel.max(0) >= (source.rows, source.cols)).any():
        raise ValueError(f"hsi_pixel leaves the cube of {source.rows} x {source.cols} pixels")
    if not np.isfinite(arrays["xyz"]).all():
        raise ValueError("xyz is not finite everywhere; a pixel without surface has no point")
    return CloudPoints(**arrays)


def _write_spectra(
    group: Path,
    points: CloudPoints,
    source: SpectraSource,
    encoding: Encoding,
    saturation: float | None,
    durable: bool,
    progress: Callable[[float], None] | None,
) -> tuple[NDArray[np.uint8], EncodingCounts]:
    """Write the array ``spectra``; the flags (S,) that the spectra set, and what was clipped."""
    size = len(points)
    encoder = SpectraEncoder(source, encoding, saturation)
    flags = np.empty(size, np.uint8)
    with _create(group, "spectra", (size, source.bands), encoding.attributes(), durable) as array:
        for raw, start, take in _strips_in_tile_order(points.hsi_pixel, source):
            stop = start + len(take)
            block = np.empty((len(take), source.bands), np.uint16)
            flags[start:stop] = encoder.gather(raw, take, block)
            array.write(start, block)
            if progress:
                progress(0.95 * stop / size)
    return flags, encoder.counts


def _strips_in_tile_order(
    pixels: NDArray[np.uint16], source: SpectraSource
) -> Iterator[tuple[Array, int, NDArray[np.intp]]]:
    """Values (m, B) of each strip of tiles that has points, its first point, its points' rows in them."""
    row = pixels[:, 0]
    for first_row, stop_row in strips(source):
        # Points are in the order of tiles, so the rows of tiles increase, though the rows in them do not.
        start, stop = np.searchsorted(row >> 4, [first_row >> 4, (first_row >> 4) + 1])
        if start == stop:
            continue
        raw = source.read_rows(first_row, stop_row).reshape(-1, source.bands)
        strip = pixels[start:stop].astype(np.intp)
        yield raw, int(start), (strip[:, 0] - first_row) * source.cols + strip[:, 1]


class _ArrayWriter:
    """Writes an array from its first point to its last, one transaction a shard.

    tensorstore's own threads compress and write a shard while the caller prepares the next.
    """

    def __init__(self, array: tensorstore.TensorStore, shard: int) -> None:
        self._array, self._shard = array, shard
        self._open: tensorstore.Transaction | None = None
        self._committing: tensorstore.Future[None] | None = None

    def write(self, start: int, values: Array) -> None:
        """Write points [start, start + len(values)); the calls follow each other without gaps."""
        while len(values):
            room = self._shard - start % self._shard
            part, values = values[:room], values[room:]
            if self._committing and start % self._shard >= self._shard // 4:
                # The shard before must be gone before this one grows large, so that memory stays bounded.
                self._committing.result()
                self._committing = None
            self._open = self._open or tensorstore.Transaction()
            target = self._array.with_transaction(self._open)[start : start + len(part)]
            target.write(part).copy.result()
            start += len(part)
            if start % self._shard == 0:
                self._commit()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Wait until all is written; after an exception, until nothing is being written any more."""
        if error is None:
            self._commit()
            self._commit()
            return
        if self._open:
            self._open.abort()
        if self._committing:
            self._committing.exception()

    def _commit(self) -> None:
        # At most one shard is under way.
        if self._committing:
            self._committing.result()
        self._committing = self._open.commit_async() if self._open else None
        self._open = None


def _write_array(group: Path, name: str, values: Array, durable: bool) -> None:
    with _create(group, name, values.shape, {}, durable) as array:
        array.write(0, values)


def _create(group: Path, name: str, shape: Sequence[int], attributes: dict[str, object], durable: bool) -> _ArrayWriter:
    spec = ARRAYS[name]
    rest = list(shape[1:])
    by_point = spec.dimensions[0] == "point"
    inner = spec.chunk_points if by_point else shape[0]
    outer = SHARD_POINTS if by_point else shape[0]
    if spec.units:
        attributes = {"units": spec.units, **attributes}
    if name == "flags":  # as CF spells bits
        meanings = " ".join(flag.name.lower() for flag in Flag if flag.name)
        attributes = {"flag_masks": [int(flag) for flag in Flag], "flag_meanings": meanings}
    array = tensorstore.open(
        {
            "driver": "zarr3",
            # It refuses paths with "..".
            "kvstore": {"driver": "file", "path": f"{(group / name).resolve()}/"},
            "context": {"file_io_sync": durable},
            # A missing file then always means damage.
            "store_data_equal_to_fill_value": True,
            "create": True,
            "metadata": {
                "shape": list(shape),
                "data_type": spec.dtype,
                "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [outer, *rest]}},
                "codecs": [_codec([inner, *rest], np.dtype(spec.dtype).itemsize)],
                "fill_value": 0,
                "dimension_names": list(spec.dimensions),
                "attributes": attributes,
            },
        }
    ).result()
    return _ArrayWriter(array, outer)


def _codec(inner: list[int], itemsize: int) -> dict[str, object]:
    little = {"name": "bytes", "configuration": {"endian": "little"}}
    blosc = {"cname": "lz4", "clevel": 5, "shuffle": "bitshuffle", "typesize": itemsize, "blocksize": 0}
    return {
        "name": "sharding_indexed",
        "configuration": {
            "chunk_shape": inner,
            "codecs": [little, {"name": "blosc", "configuration": blosc}],
            "index_codecs": [little, {"name": "crc32c"}],
        },
    }


def _write_group_metadata(group: Path, attributes: dict[str, object]) -> None:
    # Not consolidated: labels are added later, and a copy of their metadata here would go stale.
    document = {"zarr_format": 3, "node_type": "group", "attributes": attributes}
    (group / "zarr.json").write_text(json_text(document, indent=1), encoding="utf-8")


@contextmanager
def _storage_errors() -> Iterator[None]:
    """tensorstore reports the system's errors as ValueError: give them back their number."""
    try:
        yield
    except ValueError as error:
        found = re.search(r"os_error_code='(\d+)'", str(error))
        if found is None:
            raise
        code = int(found[1])
        raise OSError(code, os.strerror(code)) from error
    except MemoryError as error:
        raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)) from error
