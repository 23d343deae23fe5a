"""HDF5 and what is written in it: NetCDF4, MATLAB 7.3.

A file may have been sent by a stranger: links, external storage and virtual datasets, which lead to other
files of the machine, are not followed.
"""

from __future__ import annotations

import re
from pathlib import Path

import h5py
import numpy as np

from specimap.core.cube.declared import WORDS, Declared, declared_of, is_word, plain
from specimap.core.cube.discover import Variable, choose_cube, choose_wavelengths, cube_axes
from specimap.core.cube.model import Cube, describe
from specimap.core.cube.pixels import ArrayPixels, Pixels
from specimap.core.cube.scratch import scratch_array
from specimap.core.cube.strided import native
from specimap.core.errors import CubeContentError, CubeFormatError, CubeTruncatedError
from specimap.core.geometry import Array, Floats

# A larger row of chunks is not kept decoded while it is read by rows: the cube is unpacked once instead.
_LARGEST_CHUNK_ROW = 512 << 20
_TRUNCATED = re.compile(r"truncated file: eof = (\d+).*stored_eof = (\d+)")


class HdfFormat:
    """The one numeric dataset with three axes; wavelengths by name; MATLAB's reversed axes put right."""

    name = "HDF5"
    suffixes: tuple[str, ...] = (".h5", ".hdf5", ".hdf", ".he5", ".nc", ".nc4", ".mat")

    def matches(self, path: Path) -> bool:
        return bool(h5py.is_hdf5(path))

    def open(self, path: Path) -> Cube:
        try:
            with h5py.File(path, "r") as file:
                variables = _variables(file)
                cube = choose_cube(path, variables)
                wavelengths = choose_wavelengths(variables, cube)
                values: Floats | None = None
                if wavelengths is not None:
                    values = np.array(file[wavelengths.name][()], np.float64).ravel()
                reversed_axes = "MATLAB_class" in file[cube.name].attrs
                axes, warnings = cube_axes(cube, wavelengths, reversed_axes=reversed_axes)
                declared = _declared(path, file, cube)
                pixels = _pixels(path, file[cube.name], axes)
        except OSError as error:
            sizes = _TRUNCATED.search(str(error))
            if sizes is None:
                raise
            raise CubeTruncatedError(
                f"{path.name} holds {sizes[1]} bytes of {sizes[2]}.",
                advice="Copy the cube again, completely.",
                expected_bytes=int(sizes[2]), found_bytes=int(sizes[1]),
            ) from error  # fmt: skip
        return describe(
            path,
            "MATLAB 7.3" if reversed_axes else self.name,
            pixels,
            wavelengths=values,
            units=wavelengths.units if wavelengths else None,
            declared=declared,
            warnings=warnings,
        )


def _variables(file: h5py.File) -> list[Variable]:
    found: list[Variable] = []

    def visit(name: str, node: object) -> None:  # visititems follows hard links alone
        if isinstance(node, h5py.Dataset) and node.shape is not None:
            axes = tuple(_axis_name(node, i) for i in range(len(node.shape)))
            units = _text(node.attrs.get("units", node.attrs.get("Units")))
            found.append(Variable(name, tuple(node.shape), node.dtype, axes, units))

    file.visititems(visit)
    return found


def _axis_name(node: h5py.Dataset, axis: int) -> str:
    """The axis' label, or the name of the dimension scale that NetCDF4 attaches to it."""
    try:
        if node.dims[axis].label:
            return str(node.dims[axis].label)
        return str(node.dims[axis].keys()[0] or node.dims[axis][0].name).rpartition("/")[2]
    except (IndexError, RuntimeError):
        return ""


def _text(value: object) -> str | None:
    if isinstance(value, np.ndarray):
        value = value.ravel()[0] if value.size else None
    if isinstance(value, bytes):
        return value.decode("utf-8", "replace")
    return value if isinstance(value, str) else None


def _declared(path: Path, file: h5py.File, cube: Variable) -> Declared:
    """What the cube's own attributes say of its values, and small data sets beside it (MATLAB keeps them so)."""
    dataset = file[cube.name]
    said: dict[str, object] = {}
    for name in dataset.parent:
        # Links may lead out of the file: only what stands in it is looked at.
        if plain(name) in WORDS and isinstance(dataset.parent.get(name, getlink=True), h5py.HardLink):
            node = dataset.parent[name]
            if _is_own(node) and is_word(name, node.shape):
                said[name] = node[()]
    said |= {name: value for name, value in dataset.attrs.items() if plain(name) in (*WORDS, "unsigned")}
    titles = (_text(dataset.attrs.get(title)) for title in ("long_name", "standard_name"))
    return declared_of(path.name, said, cube.name, *titles)


def _is_own(node: object) -> bool:
    """Whether a node is a data set whose values lie in the file itself."""
    return isinstance(node, h5py.Dataset) and not node.external and not node.is_virtual and node.shape is not None


def _pixels(path: Path, dataset: h5py.Dataset, axes: tuple[int, int, int]) -> Pixels:
    if dataset.external or dataset.is_virtual:
        raise CubeFormatError(
            f"'{dataset.name}' in {path.name} keeps its values in other files.",
            advice="Save the cube as one file.",
        )
    offset = dataset.id.get_offset()
    if dataset.chunks is None and offset is not None:
        mapped = np.memmap(path, dataset.dtype, "r", offset=offset, shape=dataset.shape)
        return ArrayPixels(np.asarray(mapped).transpose(axes))
    chunk = dataset.chunks or (1, 1, 1)
    rows = chunk[axes[0]]
    row_bytes = rows * dataset.shape[axes[1]] * dataset.shape[axes[2]] * dataset.dtype.itemsize
    if row_bytes <= _LARGEST_CHUNK_ROW:
        return _ChunkedPixels(path, dataset.name, axes, rows, row_bytes)
    unpacked = scratch_array(dataset.shape, dataset.dtype)
    dataset.read_direct(unpacked)
    return ArrayPixels(unpacked.transpose(axes))


class _ChunkedPixels(Pixels):
    """A dataset in chunks, decoded as its rows are read; one row of chunks stays decoded."""

    def __init__(self, path: Path, name: str, axes: tuple[int, int, int], chunk_rows: int, row_bytes: int) -> None:
        # A cache of its own that holds a row of chunks: each is decoded once, however few rows are asked for.
        self._file = h5py.File(path, "r", rdcc_nbytes=max(1 << 20, row_bytes * 2), rdcc_nslots=100_003)
        self._dataset = self._file[name]
        self._axes = axes
        self._chunk_rows = chunk_rows
        rows, cols, bands = (int(self._dataset.shape[axis]) for axis in axes)
        self.shape = (rows, cols, bands)
        self.dtype = native(self._dataset.dtype)

    def _read(self, axis: int, part: slice) -> Array:
        selection = [slice(None)] * 3
        selection[self._axes[axis]] = part
        try:
            return np.asarray(self._dataset[tuple(selection)]).transpose(self._axes)
        except OSError as error:
            raise CubeContentError(
                f"'{self._dataset.name}' does not decode: {error}.",
                advice="Save the cube again, uncompressed or with gzip.",
            ) from error

    def block(self, start: int, stop: int) -> Array:
        return self._read(0, slice(start, stop))

    def band(self, index: int) -> Array:
        return np.ascontiguousarray(self._read(2, slice(index, index + 1))[:, :, 0], self.dtype)

    def strip_rows(self) -> int:
        whole = max(1, super().strip_rows() // self._chunk_rows)
        return whole * self._chunk_rows
