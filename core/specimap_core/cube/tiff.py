"""TIFF: one band a page, or one page with a sample for each band.

The file may have been sent by a stranger: tifffile gets it open and without its name, and with every kind of series
switched off that may lead it to other files (OME, Micro-Manager, NDTiff and the like).
"""

from __future__ import annotations

import logging
import re
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import tifffile

from specimap_core.arrays import Array
from specimap_core.cube.declared_values import WORDS, declared_of, plain
from specimap_core.cube.discover import Variable, cube_axes
from specimap_core.cube.model import Cube, check_dtype, describe
from specimap_core.cube.npy import refuse_dataset, starts_with
from specimap_core.cube.pixels import ArrayPixels
from specimap_core.cube.tiff_wavelengths import named_wavelengths
from specimap_core.cube.unpacked import scratch_array
from specimap_core.errors import CubeFormatError, CubeTruncatedError
from specimap_core.notices import Notice, Notices

_GDAL_METADATA, _GDAL_NODATA = 42112, 42113
_GDAL_ITEM = re.compile(r"<Item\b[^>]*\bsample=\"(\d+)\"[^>]*>([^<]*)</Item>")
# CF's words, which mean the same.
_GAINS, _OFFSETS = "scale_factor", "add_offset"
_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# What tifffile itself writes, and what is read of the one file alone. Anything else of its kinds is read as plain
# pages; asking the library for its list leaves out no kind that it may learn.
_OWN_KINDS = {"shaped", "uniform", "imagej", "volumetric"}
_ONE_FILE = {f"is_{kind}": False for kind in tifffile.TIFF.FILE_FLAGS - _OWN_KINDS}
_LOSSLESS = {
    "NONE",
    "LZW",
    "ADOBE_DEFLATE",
    "DEFLATE",
    "PACKBITS",
    "LZMA",
    "ZSTD",
    "ZSTD_DEPRECATED",
}
_JPEG = "JPEG"
_PREDICTORS = {"NONE", "HORIZONTAL", "FLOATINGPOINT"}


class TiffFormat:
    """The largest series of the file, mapped where it is stored whole and uncompressed, else decoded."""

    name = "TIFF"
    suffixes: tuple[str, ...] = (".tif", ".tiff", ".btf")
    stored_suffix: str | None = ".tif"

    def matches(self, path: Path) -> bool:
        return any(starts_with(path, magic) for magic in _MAGIC)

    def open(self, path: Path, dataset: str | None = None) -> Cube:
        refuse_dataset(path, dataset)
        with _opened(path) as file:
            series = _largest(file)
            if series.ndim < 3 and len(file.pages) > 1:
                # Bands that were written one by one, each as a series of its own.
                with _opened(path, is_shaped=False, is_imagej=False, is_volumetric=False) as plain:
                    return self._cube(path, plain, _largest(plain))
            return self._cube(path, file, series)

    def _cube(self, path: Path, file: tifffile.TiffFile, series: tifffile.TiffPageSeries) -> Cube:
        check_dtype(path, series.dtype)
        packing = _check_packing(path, series)
        _check_complete(path, file, series)
        wavelengths, units = named_wavelengths(file)
        axes, about_axes = _axes(path, series, None if wavelengths is None else len(wavelengths))
        array = _values(path, file, series)
        declared = declared_of(path.name, _declared_attributes(file, array.shape[axes[2]] if len(axes) == 3 else 1))
        if len(axes) == 2:
            array, axes = array[..., None], (*axes, 2)
        return describe(
            path,
            self.name,
            ArrayPixels(array.transpose(axes)),
            wavelengths=wavelengths,
            units=units,
            declared=declared,
            warnings=packing + _other_series(file, series) + about_axes,
        )


@contextmanager
def _opened(path: Path, **kinds: bool) -> Iterator[tifffile.TiffFile]:
    # It prints what it thinks of odd tags to the user's terminal, such as GDAL's own no-data value of float32.
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    with open(path, "rb") as stream, tifffile.TiffFile(stream, _multifile=False, **_ONE_FILE | kinds) as file:
        yield file


def _largest(file: tifffile.TiffFile) -> tifffile.TiffPageSeries:
    return max(file.series, key=lambda s: s.nbytes)


def _other_series(file: tifffile.TiffFile, chosen: tifffile.TiffPageSeries) -> Notices:
    others = [s for s in file.series if s is not chosen and s.ndim >= 3 and s.nbytes * 2 > chosen.nbytes]
    if not others:
        return ()
    shown = ", ".join(f"{'x'.join(map(str, s.shape))} ({s.axes})" for s in others)
    text = f"The file holds several images; the one of {'x'.join(map(str, chosen.shape))} ({chosen.axes}) was taken"
    return (Notice("dataset_chosen", f"{text}, not {shown}."),)


def _check_packing(path: Path, series: tifffile.TiffPageSeries) -> Notices:
    """Raises CubeFormatError for a compression or predictor that is not read, by its name."""
    keyframes = {id(page.keyframe): page.keyframe for page in series.pages if page is not None}
    packings = {_name(tifffile.COMPRESSION, page.compression) for page in keyframes.values()}
    predictors = {_name(tifffile.PREDICTOR, page.predictor) for page in keyframes.values()}
    foreign = sorted(packings - _LOSSLESS - {_JPEG}) or sorted(f"predictor {p}" for p in predictors - _PREDICTORS)
    if foreign:
        raise CubeFormatError(
            f"{path.name} is compressed with {foreign[0]}, which is not supported.",
            advice="Save it uncompressed, or with LZW, Deflate or ZSTD: gdal_translate -co COMPRESS=DEFLATE IN OUT.",
            compression=foreign[0],
        )
    if _JPEG in packings:
        text = "The TIFF is compressed with JPEG, which changes values: spectra are not exact."
        return (Notice("values_lossy", text),)
    return ()


def _name(names: type[tifffile.COMPRESSION] | type[tifffile.PREDICTOR], code: int) -> str:
    try:
        return str(names(code).name)
    except ValueError:
        return f"number {int(code)}"


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


def _axes(path: Path, series: tifffile.TiffPageSeries, count: int | None) -> tuple[tuple[int, ...], Notices]:
    """Stored axes as (rows, cols) or (rows, cols, bands), and a warning where that was a guess.

    The bands' axis is the one that is neither Y nor X, unless only another one is as long as the ``count`` of
    wavelengths: software that knows no spectra writes each row of a cube as a page.
    """
    names, shape = series.axes, tuple(series.shape)
    if names.count("Y") != 1 or names.count("X") != 1 or len(shape) not in (2, 3) or 0 in shape:
        sides = ", ".join(f"{name} {side}" for name, side in zip(names, shape, strict=True))
        raise CubeFormatError(
            f"{path.name} holds images of shape {shape} with axes {names} ({sides}), not a cube.",
            advice="Save one page for each band, or one page with a sample for each band.",
            shape=list(shape),
            axes=names,
        )
    if len(shape) == 2:
        return (names.index("Y"), names.index("X")), ()
    cube = Variable(path.name, shape, series.dtype, tuple(n.lower() if n in "YX" else "band" for n in names))
    wavelengths = None if count is None else Variable("wavelengths", (count,), np.dtype(float))
    return cube_axes(cube, wavelengths, reversed_axes=False)


def _values(path: Path, file: tifffile.TiffFile, series: tifffile.TiffPageSeries) -> Array:
    if series.dataoffset is not None:
        dtype = series.dtype.newbyteorder(file.byteorder)
        return np.asarray(np.memmap(path, dtype, "r", offset=series.dataoffset, shape=series.shape))
    out = scratch_array(tuple(series.shape), series.dtype)
    series.asarray(out=out)
    return out


def _declared_attributes(file: tifffile.TiffFile, bands: int) -> dict[str, object]:
    """What GDAL's tags and the JSON description that tifffile writes say of the values."""
    stated: dict[str, object] = {}
    for described in file.shaped_metadata or ():
        stated |= {name: value for name, value in described.items() if plain(name) in WORDS}
    tags = file.pages.first.tags
    if _GDAL_NODATA in tags:
        stated["nodata"] = str(tags[_GDAL_NODATA].value)
    if _GDAL_METADATA in tags:
        text = str(tags[_GDAL_METADATA].value)
        for role, name, usual in (("scale", _GAINS, "1"), ("offset", _OFFSETS, "0")):
            numbers = [usual] * bands
            for found in _GDAL_ITEM.finditer(text):
                sample = int(found[1])
                if f'role="{role}"' in found[0] and sample < bands:
                    numbers[sample] = found[2]
            stated[name] = " ".join(numbers)
    return stated
