"""TIFF: one band a page, or one page with a sample for each band."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import tifffile

from specimap.core.cube.declared import WORDS, declared_of, plain
from specimap.core.cube.model import Cube, check_dtype, describe
from specimap.core.cube.npy import starts_with
from specimap.core.cube.pixels import ArrayPixels
from specimap.core.cube.scratch import scratch_array
from specimap.core.errors import CubeFormatError, CubeTruncatedError
from specimap.core.geometry import Array, Floats

_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
_GDAL_ITEM = re.compile(r"<Item\b[^>]*\bsample=\"(\d+)\"[^>]*>([^<]*)</Item>")
# CF's words, which mean the same.
_GAINS, _OFFSETS = "scale_factor", "add_offset"
_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


class TiffFormat:
    """The largest series of the file, mapped where it is stored whole and uncompressed, else decoded."""

    name = "TIFF"
    suffixes: tuple[str, ...] = (".tif", ".tiff", ".btf")

    def matches(self, path: Path) -> bool:
        return any(starts_with(path, magic) for magic in _MAGIC)

    def open(self, path: Path) -> Cube:
        with tifffile.TiffFile(path) as file:
            series = max(file.series, key=lambda s: s.nbytes)
            check_dtype(path, series.dtype)
            _check_complete(path, file, series)
            axes = _axes(path, series.axes, series.shape)
            array = _values(path, file, series)
            wavelengths = _wavelengths(file)
            declared = declared_of(path.name, _said(file, array.shape[axes[2]] if len(axes) == 3 else 1))
        if len(axes) == 2:
            array, axes = array[..., None], (*axes, 2)
        return describe(path, self.name, ArrayPixels(array.transpose(axes)), wavelengths=wavelengths, declared=declared)


def _check_complete(path: Path, file: tifffile.TiffFile, series: tifffile.TiffPageSeries) -> None:
    """tifffile reads missing values as zeros and drops missing pages: a cut file must be refused before."""
    expected = _next_directory(file)
    if series.dataoffset is not None:
        expected = max(expected, series.dataoffset + series.nbytes)
    else:
        for page in series.pages:
            if page is not None:
                spans = zip(page.dataoffsets, page.databytecounts, strict=True)
                expected = max([expected, *(start + size for start, size in spans)])
    found = path.stat().st_size
    if found < expected:
        raise CubeTruncatedError(
            f"{path.name} holds {found} bytes of at least {expected}.",
            advice="Copy the cube again, completely.",
            expected_bytes=expected,
            found_bytes=found,
        )


def _next_directory(file: tifffile.TiffFile) -> int:
    """Where the directory after the last one found should begin; 0 at the end of the chain."""
    layout, handle = file.tiff, file.filehandle
    start = file.pages[-1].offset
    handle.seek(start)
    (tags,) = struct.unpack(layout.tagnoformat, handle.read(layout.tagnosize))
    handle.seek(start + layout.tagnosize + tags * layout.tagsize)
    link = handle.read(layout.offsetsize)
    if len(link) < layout.offsetsize:
        return int(start + layout.tagnosize + tags * layout.tagsize + layout.offsetsize)
    return int(struct.unpack(layout.offsetformat, link)[0])


def _axes(path: Path, names: str, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Stored axes as (rows, cols) or (rows, cols, bands); the bands' is the one that is neither Y nor X."""
    if names.count("Y") == 1 and names.count("X") == 1 and len(shape) in (2, 3) and 0 not in shape:
        rows, cols = names.index("Y"), names.index("X")
        return (rows, cols, *(i for i in range(len(shape)) if i not in (rows, cols)))
    raise CubeFormatError(
        f"{path.name} holds images of shape {shape} with axes {names}, not a cube.",
        advice="Save one page for each band, or one page with a sample for each band.",
        shape=list(shape), axes=names,
    )  # fmt: skip


def _values(path: Path, file: tifffile.TiffFile, series: tifffile.TiffPageSeries) -> Array:
    if series.dataoffset is not None:
        dtype = series.dtype.newbyteorder(file.byteorder)
        return np.asarray(np.memmap(path, dtype, "r", offset=series.dataoffset, shape=series.shape))
    out = scratch_array(tuple(series.shape), series.dtype)
    series.asarray(out=out)
    return out


def _wavelengths(file: tifffile.TiffFile) -> Floats | None:
    """A list ``wavelengths`` in the JSON description that tifffile writes."""
    for described in file.shaped_metadata or ():
        values = described.get("wavelengths")
        if isinstance(values, list):
            return np.array(values, np.float64)
    return None


def _said(file: tifffile.TiffFile, bands: int) -> dict[str, object]:
    """What GDAL's tags and the JSON description that tifffile writes say of the values."""
    said: dict[str, object] = {}
    for described in file.shaped_metadata or ():
        said |= {name: value for name, value in described.items() if plain(name) in WORDS}
    tags = file.pages.first.tags
    if _GDAL_NODATA in tags:
        said["nodata"] = str(tags[_GDAL_NODATA].value)
    if _GDAL_METADATA in tags:
        text = str(tags[_GDAL_METADATA].value)
        for role, name, usual in (("scale", _GAINS, "1"), ("offset", _OFFSETS, "0")):
            numbers = [usual] * bands
            for found in _GDAL_ITEM.finditer(text):
                sample = int(found[1])
                if f'role="{role}"' in found[0] and sample < bands:
                    numbers[sample] = found[2]
            said[name] = " ".join(numbers)
    return said
